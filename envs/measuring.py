"""What evaluations read of a step."""

from __future__ import annotations

import torch

from kiras_rl.envs.state import CONTACT_FORCE, Limits, RobotState
from kiras_rl.interfaces import Measurements


def measure(
    robot: RobotState, limits: Limits, distance: torch.Tensor, fallen: torch.Tensor
) -> Measurements:
    """Collect the measurements of a step.

    What lies in the simulation's own buffers is copied: what a reset or a push does next is no
    part of the step.

    Args:
        robot: The robots after the step.
        limits: Of their joints and motors.
        distance: From the middle of the tile, (N,), m.
        fallen: Worlds that terminate by failure, or whose physics broke or ran out of memory:
            what comes after is another life, (N,) bool.
    """
    foot_load, limb_load = robot.loads()
    return Measurements(
        base_pos_w=robot.base_pos_w.clone(),
        base_quat_w=robot.base_quat_w.clone(),
        base_height=robot.base_height.clone(),
        pitch=robot.roll_pitch[:, 1],
        roll=robot.roll_pitch[:, 0],
        lin_vel_h=robot.base_lin_vel_h,
        ang_vel_b=robot.base_ang_vel_b.clone(),
        yaw_rate=robot.yaw_rate,
        gravity_b=robot.gravity_b,
        joint_pos=robot.joint_pos.clone(),
        joint_vel=robot.joint_vel.clone(),
        joint_torque=robot.joint_torque.clone(),
        peak_torque=robot.peak_torque,
        beyond=(limits.beyond(robot.joint_pos) > 0.0).any(dim=1),
        saturated=robot.saturation(limits.torque),
        foot_contact=robot.foot_contact,
        foot_stands=robot.foot_stands,
        foot_height=robot.foot_height,
        limb_contact=(robot.limb_force > CONTACT_FORCE).any(dim=1),
        foot_load=foot_load,
        limb_load=limb_load,
        distance=distance,
        fallen=fallen,
    )
