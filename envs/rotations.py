"""Rotations of batches; quaternions are (w, x, y, z)."""

from __future__ import annotations

import numpy as np
import torch
from torch.nn.functional import normalize


def matrix(quat: torch.Tensor) -> torch.Tensor:
    """Return the rotations that express vectors of the body in the world.

    Their entries are linear in the products of the quaternion's components: two operations make
    all of them, which counts where each is a kernel launch.

    Args:
        quat: Unit quaternions, (N, 4).

    Returns:
        (N, 3, 3).
    """
    products = (quat[:, :, None] * quat[:, None, :]).flatten(1)
    return (products @ _of_products(quat.device, quat.dtype)).unflatten(1, (3, 3))


_PRODUCTS: dict[tuple[torch.device, torch.dtype], torch.Tensor] = {}


def _of_products(device: torch.device, dtype: torch.dtype) -> torch.Tensor:
    """Return what each product adds to each entry of (w^2 - u.u) 1 + 2 u u' + 2 w [u]x, (16, 9)."""
    if (device, dtype) not in _PRODUCTS:
        one, terms = np.eye(3), np.zeros((4, 4, 3, 3))
        terms[0, 0] = one
        for i in range(3):
            terms[1 + i, 1 + i] -= one
            terms[1 + i, 1:, i] += 2.0 * one
            terms[0, 1 + i] = 2.0 * np.cross(one[i], one).T
        _PRODUCTS[device, dtype] = torch.tensor(terms.reshape(16, 9), device=device, dtype=dtype)
    return _PRODUCTS[device, dtype]


def projected_gravity(rotation: torch.Tensor) -> torch.Tensor:
    """Return the unit vector of gravity in the body frame of rotations (N, 3, 3).

    Returns:
        (N, 3); (sin pitch, 0, -cos pitch) without roll.
    """
    return -rotation[:, 2]


def yaw(rotation: torch.Tensor) -> torch.Tensor:
    """Return the heading of the x axis of rotations (N, 3, 3), (N,), rad."""
    return torch.atan2(rotation[:, 1, 0], rotation[:, 0, 0])


def wrap(angle: torch.Tensor) -> torch.Tensor:
    """Return the angle in [-pi, pi)."""
    return torch.remainder(angle + torch.pi, 2.0 * torch.pi) - torch.pi


def turn(points: torch.Tensor, yaw: torch.Tensor) -> torch.Tensor:
    """Rotate horizontal points (P, 2) by each yaw (N,), (N, P, 2)."""
    cos, sin = torch.cos(yaw)[:, None], torch.sin(yaw)[:, None]
    x, y = points[:, 0], points[:, 1]
    return torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1)


def to_heading_frame(rotation: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """Rotate world vectors (N, 3) by minus the yaw of rotations (N, 3, 3)."""
    cos, sin = normalize(rotation[:, :2, 0], eps=1e-6).unbind(-1)
    x, y, z = vector.unbind(-1)
    return torch.stack([cos * x + sin * y, cos * y - sin * x, z], dim=-1)


def roll_pitch(gravity_b: torch.Tensor) -> torch.Tensor:
    """Return roll and pitch (nose down positive) from projected gravity, (N, 2), rad."""
    _, y, z = (-gravity_b).unbind(-1)
    pitch = torch.asin(gravity_b[:, 0].clamp(-1.0, 1.0))
    return torch.stack([torch.atan2(y, z), pitch], dim=-1)


def quat_from_pitch_yaw(pitch: torch.Tensor, yaw: torch.Tensor) -> torch.Tensor:
    """Return the quaternion of a pitch after a yaw, (N, 4)."""
    cp, sp = torch.cos(pitch / 2), torch.sin(pitch / 2)
    cy, sy = torch.cos(yaw / 2), torch.sin(yaw / 2)
    return torch.stack([cy * cp, -sy * sp, cy * sp, sy * cp], dim=-1)
