"""What a robot cannot do: where physics is finite, and still broken."""

from __future__ import annotations

import torch

from kiras_rl.envs.state import Keyframes, RobotState

BASE_SPEED = 20.0  # m/s
BASE_TURN = 200.0  # rad/s
JOINT_SPEED = 300.0  # rad/s
FOOT_SPEED = 50.0  # m/s
FORCE = 1000.0  # weights of the robot, on a foot or another part
DEPTH = 0.5  # m below the ground
JUMP = 5.0  # m above the highest posture


def broken(robot: RobotState, keyframes: Keyframes, weight: float) -> torch.Tensor:
    """Return the worlds whose robot is out of physical bounds, (N,) bool; NaN is so, too.

    Args:
        robot: The robots after a step.
        keyframes: The skills.
        weight: Of a robot, N.
    """
    height, top = robot.base_height, keyframes.height.max() + JUMP
    sound = (height > -DEPTH) & (height < top)
    limits = (
        (robot.base_lin_vel_b, BASE_SPEED),
        (robot.base_ang_vel_b, BASE_TURN),
        (robot.joint_vel, JOINT_SPEED),
        (robot.foot_vel_w.flatten(1), FOOT_SPEED),
        (robot.foot_force, FORCE * weight),
        (robot.base_force, FORCE * weight),
        (robot.limb_force, FORCE * weight),
    )
    for values, limit in limits:
        sound = sound & (values.abs() < limit).all(dim=1)
    return ~sound
