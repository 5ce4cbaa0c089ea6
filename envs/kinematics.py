"""Forward kinematics of the feet for whole batches: where to put the base at a reset."""

from __future__ import annotations

import mujoco
import torch

from kiras_rl.robots.robot import Robot


class FootKinematics:
    """Chains of hinges from the base to each foot; all chains have the same length.

    Letters: F feet, L links of a chain, J joints.
    """

    def __init__(self, model: mujoco.MjModel, robot: Robot, device: torch.device) -> None:
        """Read the chains from the compiled model."""
        chains = [_chain(model, robot, foot) for foot in robot.foot_geoms]

        def stack(key: str, dtype: torch.dtype) -> torch.Tensor:
            return torch.tensor([c[key] for c in chains], dtype=dtype, device=device)

        self._joints = stack("joints", torch.int64)  # (F, L)
        self._axes = stack("axes", torch.float32)  # (F, L, 3)
        self._offsets = stack("offsets", torch.float32)  # (F, L, 3), in the parent link
        self._feet = stack("foot", torch.float32)  # (F, 3), in the last link
        self._radius = robot.foot_radius

    def foot_pos_b(self, joint_pos: torch.Tensor) -> torch.Tensor:
        """Return the centres of the feet in the base frame, (N, F, 3), m.

        Args:
            joint_pos: Joint angles, (N, J), rad.
        """
        pos = self._feet.expand(len(joint_pos), -1, -1)
        for link in reversed(range(self._joints.shape[1])):
            angle = joint_pos[:, self._joints[:, link]].unsqueeze(-1)  # (N, F, 1)
            pos = self._offsets[:, link] + _rotate(self._axes[:, link], angle, pos)
        return pos

    def lowest_foot(self, pitch: torch.Tensor, joint_pos: torch.Tensor) -> torch.Tensor:
        """Return the height of the lowest foot below a base pitched by (N,) rad, (N,), m."""
        pos = self.foot_pos_b(joint_pos)
        height = -torch.sin(pitch)[:, None] * pos[..., 0] + torch.cos(pitch)[:, None] * pos[..., 2]
        return height.amin(dim=1) - self._radius


def _chain(model: mujoco.MjModel, robot: Robot, foot: str) -> dict[str, list]:
    geom = model.geom(foot)
    chain: dict[str, list] = {"joints": [], "axes": [], "offsets": [], "foot": list(geom.pos)}
    body = int(geom.bodyid[0])
    base = model.body(robot.base_body).id
    while body != base:
        joint = model.joint(int(model.body_jntadr[body]))
        chain["joints"].insert(0, robot.joint_names.index(joint.name))
        chain["axes"].insert(0, list(joint.axis))
        chain["offsets"].insert(0, list(model.body_pos[body]))
        body = int(model.body_parentid[body])
    return chain


def _rotate(axis: torch.Tensor, angle: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """Rotate (N, F, 3) about unit axes (F, 3) by (N, F, 1) rad (Rodrigues)."""
    axis = axis.expand_as(vector)
    along = axis * (axis * vector).sum(-1, keepdim=True)
    across = torch.linalg.cross(axis, vector)
    return along + torch.cos(angle) * (vector - along) + torch.sin(angle) * across
