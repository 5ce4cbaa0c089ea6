"""Ends of an episode by failure: one function a reason, (N,) bool. Time-outs are no failure."""

from __future__ import annotations

import math

import torch

from kiras_rl.envs.state import Keyframes, RobotState, Task
from kiras_rl.schema import TerminationConfig


def fallen(
    robot: RobotState, task: Task, keyframes: Keyframes, limits: TerminationConfig
) -> torch.Tensor:
    """Return the worlds that fail by any of the reasons below."""
    cos_limit = math.cos(math.radians(limits.max_tilt))
    pressed = base_contact(robot, limits.base_contact_force)
    return pressed | tilted(robot, task, keyframes, cos_limit)


def base_contact(robot: RobotState, force: float) -> torch.Tensor:
    """Return the worlds whose base pressed on the ground with more than `force` N."""
    return (robot.base_force > force).any(dim=-1)


def tilted(robot: RobotState, task: Task, keyframes: Keyframes, cos_limit: float) -> torch.Tensor:
    """Return the worlds whose gravity is far from that of both target and start keyframe.

    Args:
        robot: The robots.
        task: Their skills and start keyframes.
        keyframes: The skills.
        cos_limit: Cosine of the largest angle allowed.
    """
    target = (robot.gravity_b * keyframes.gravity_b[task.skill]).sum(-1)
    start = (robot.gravity_b * keyframes.gravity_b[task.start]).sum(-1)
    return torch.maximum(target, start) < cos_limit
