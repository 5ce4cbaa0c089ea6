"""Rotations of batches; quaternions are (w, x, y, z)."""

from __future__ import annotations

import torch


def projected_gravity(quat: torch.Tensor) -> torch.Tensor:
    """Return the unit vector of gravity in the body frame.

    Args:
        quat: Body orientation in the world, (N, 4).

    Returns:
        (N, 3); (sin pitch, 0, -cos pitch) without roll.
    """
    w, x, y, z = quat.unbind(-1)
    return torch.stack(
        [2.0 * (w * y - x * z), -2.0 * (y * z + w * x), 2.0 * (x * x + y * y) - 1.0], dim=-1
    )


def rotate_inverse(quat: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """Express world vectors (N, 3) in the frames of `quat` (N, 4)."""
    w, u = quat[:, :1], quat[:, 1:]
    t = 2.0 * torch.linalg.cross(u, vector)
    return vector - w * t + torch.linalg.cross(u, t)


def rotate(quat: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """Express vectors (N, ..., 3) of the frames of `quat` (N, 4) in the world."""
    quat = quat.view(len(quat), *[1] * (vector.dim() - 2), 4)
    w, u = quat[..., :1], quat[..., 1:].expand_as(vector)
    t = 2.0 * torch.linalg.cross(u, vector)
    return vector + w * t + torch.linalg.cross(u, t)


def yaw(quat: torch.Tensor) -> torch.Tensor:
    """Return the heading of the x axis of `quat` (N, 4), (N,), rad."""
    w, x, y, z = quat.unbind(-1)
    return torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def wrap(angle: torch.Tensor) -> torch.Tensor:
    """Return the angle in [-pi, pi)."""
    return torch.remainder(angle + torch.pi, 2.0 * torch.pi) - torch.pi


def turn(points: torch.Tensor, yaw: torch.Tensor) -> torch.Tensor:
    """Rotate horizontal points (P, 2) by each yaw (N,), (N, P, 2)."""
    cos, sin = torch.cos(yaw)[:, None], torch.sin(yaw)[:, None]
    x, y = points[:, 0], points[:, 1]
    return torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1)


def to_heading_frame(quat: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """Rotate world vectors (N, 3) by minus the yaw of `quat` (N, 4)."""
    w, x, y, z = quat.unbind(-1)
    cos, sin = 1.0 - 2.0 * (y * y + z * z), 2.0 * (w * z + x * y)
    norm = torch.sqrt(cos * cos + sin * sin).clamp(min=1e-6)
    cos, sin = cos / norm, sin / norm
    vx, vy, vz = vector.unbind(-1)
    return torch.stack([cos * vx + sin * vy, cos * vy - sin * vx, vz], dim=-1)


def roll_pitch(gravity_b: torch.Tensor) -> torch.Tensor:
    """Return roll and pitch (nose down positive) from projected gravity, (N, 2), rad."""
    roll = torch.atan2(-gravity_b[:, 1], -gravity_b[:, 2])
    pitch = torch.asin(gravity_b[:, 0].clamp(-1.0, 1.0))
    return torch.stack([roll, pitch], dim=-1)


def quat_from_pitch_yaw(pitch: torch.Tensor, yaw: torch.Tensor) -> torch.Tensor:
    """Return the quaternion of a pitch after a yaw, (N, 4)."""
    cp, sp = torch.cos(pitch / 2), torch.sin(pitch / 2)
    cy, sy = torch.cos(yaw / 2), torch.sin(yaw / 2)
    return torch.stack([cy * cp, -sy * sp, cy * sp, sy * cp], dim=-1)
