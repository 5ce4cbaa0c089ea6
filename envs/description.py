"""What a robot must know to run a policy that was trained here."""

from __future__ import annotations

from kiras_rl.envs.observations import ObservationGroup
from kiras_rl.robots.robot import Robot
from kiras_rl.schema import EnvConfig


def describe_deployment(
    robot: Robot, config: EnvConfig, proprio: ObservationGroup, step_dt: float
) -> dict:
    """Return joints, gains, observation layout and skills as plain values.

    Args:
        robot: The robot.
        config: The environment it was trained in.
        proprio: The observation group that the robot has to rebuild.
        step_dt: Duration of a control step, s.
    """
    rows = zip(proprio.names, proprio.sizes, proprio.scales, proprio.onboard, strict=True)
    terms = [
        {"name": name, "size": size, "scale": scale} | ({"onboard": twin} if twin else {})
        for name, size, scale, twin in rows
    ]
    arrays = ("default_joint_pos", "kp", "kd", "torque_limit", "action_scale")
    commands = ("lin_vel_x", "lin_vel_y", "ang_vel_z")
    return {
        "robot": robot.name,
        "joint_names": list(robot.joint_names),
        **{name: getattr(robot, name).tolist() for name in arrays},
        "joint_limits": robot.joint_limits.tolist(),
        "velocity_limit": robot.velocity_limit.tolist(),
        "action_clip": config.action_clip,
        "observation": terms,
        "history_length": config.observations.history_length,
        "skills": list(robot.skills),
        "keyframes": {
            k.name: {
                "base_height": k.base_height,
                "pitch": k.pitch,
                "joint_pos": k.joint_pos.tolist(),
            }
            for k in robot.keyframes
        },
        "control_rate": 1.0 / step_dt,
        "command_range": {name: list(getattr(config.commands, name)) for name in commands},
        "onboard": robot.onboard,
    }
