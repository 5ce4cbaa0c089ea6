"""How the base lies over the ground that the robot stands on, whatever lies between its feet."""

from __future__ import annotations

import torch

from kiras_rl.interfaces import Measurements, SkillEnv


class Stance:
    """Height and pitch of N robots relative to the line from their rear to their front feet."""

    def __init__(self, env: SkillEnv, skill: torch.Tensor) -> None:
        """Begin in the keyframes of `skill`, (N,)."""
        self._env = env
        self._is_front = env.foot_pos_b(env.keyframe_joint_pos[skill])[..., 0] > 0
        self._height, self._pitch = env.keyframe_height[skill], env.keyframe_pitch[skill]

    def read(self, now: Measurements) -> tuple[torch.Tensor, torch.Tensor]:
        """Return height, m, and pitch, rad, (N,) each.

        Where no front foot or no rear foot stands, they are those of the step before.
        """
        ahead = forward(now.gravity_b, self._env.foot_pos_b(now.joint_pos))
        up = self._env.foot_height_b(now.gravity_b, now.joint_pos)
        height, slope = line_below(ahead, up, now.foot_contact, self._is_front)
        known = height.isfinite()
        self._height = torch.where(known, height, self._height)
        self._pitch = torch.where(known, now.pitch - slope, self._pitch)
        return self._height, self._pitch


def forward(gravity_b: torch.Tensor, pos_b: torch.Tensor) -> torch.Tensor:
    """Return how far ahead of the base points are, along its heading, (N, P), m.

    Args:
        gravity_b: Unit vector of gravity in the base frame, (N, 3).
        pos_b: Points in the base frame, (N, P, 3), m.
    """
    axis = -gravity_b[:, :1] * gravity_b  # the base's x axis, less what is vertical of it
    axis = axis + torch.tensor([1.0, 0.0, 0.0], device=axis.device)
    axis = torch.nn.functional.normalize(axis, dim=1)
    return (pos_b * axis[:, None]).sum(dim=-1)


def line_below(
    ahead: torch.Tensor, up: torch.Tensor, stands: torch.Tensor, is_front: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the line through the mean standing rear foot and the mean standing front foot.

    Args:
        ahead: How far feet are ahead of the base, (N, F), m.
        up: How far they are above the base, (N, F), m.
        stands: Which of them stand, (N, F) bool.
        is_front: Which of them are front feet, (N, F) bool.

    Returns:
        How far the line is below the base, m, and its pitch, downhill positive, rad, (N,) each;
        NaN where there is none.
    """

    def mean(values: torch.Tensor, feet: torch.Tensor) -> torch.Tensor:
        return (values * feet).sum(dim=1) / feet.sum(dim=1)

    front, rear = stands & is_front, stands & ~is_front
    rear_ahead, rear_up = mean(ahead, rear), mean(up, rear)
    steepness = (mean(up, front) - rear_up) / (mean(ahead, front) - rear_ahead)
    return steepness * rear_ahead - rear_up, -torch.atan(steepness)
