"""Robots in their keyframes: where episodes begin, and what rest looks like."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch

from kiras_rl.envs import rotations
from kiras_rl.envs.ground import Ground
from kiras_rl.envs.kinematics import FootKinematics
from kiras_rl.envs.observations import View
from kiras_rl.envs.randomness import UniformBuffer, scale_to
from kiras_rl.envs.state import Asked, Keyframes, Limits, RobotState, Task
from kiras_rl.robots.robot import Robot
from kiras_rl.schema import SkillConfig

SPAWN_CLEARANCE = 0.002  # m between the lowest foot and the ground at a reset


class Postures:
    """The keyframes of N robots, as states of the simulation and as views."""

    def __init__(
        self,
        robot: Robot,
        keyframes: Keyframes,
        kinematics: FootKinematics,
        ground: Ground | None,
        config: SkillConfig,
        widths: Mapping[str, int] | None = None,
        physics: tuple[float, float] = (1.0, 0.0),
    ) -> None:
        """Collect the constants of the robot.

        Args:
            robot: The robot.
            keyframes: Its keyframes.
            kinematics: Of its feet.
            ground: Of the worlds; None where it is flat.
            config: How episodes begin.
            widths: Of the terms of commands.
            physics: Friction and payload in kg of a robot that is not randomized.
        """
        device = keyframes.height.device

        def tensor(values: object) -> torch.Tensor:
            return torch.tensor(values, dtype=torch.float32, device=device)

        self.default_joint_pos = tensor(robot.default_joint_pos)
        self._action_scale = tensor(robot.action_scale)
        self._limits = Limits.of(robot, device)
        self._keyframes, self._kinematics, self._ground = keyframes, kinematics, ground
        self._config, self._widths = config, widths or {}
        self._physics = tensor(physics)
        self._geoms = len(robot.foot_geoms), len(robot.base_geoms), len(robot.penalised_geoms)

    def asked(self, action: torch.Tensor) -> torch.Tensor:
        """Return what actions (N, J) ask of the joints, (N, J), rad."""
        return self.default_joint_pos + self._action_scale * action

    def joint_targets(self, action: torch.Tensor) -> torch.Tensor:
        """Return the targets that actions (N, J) give the motors: inside limits, (N, J), rad."""
        return self.asked(action).clamp(self._limits.low, self._limits.high)

    def holding(self, joint_pos: torch.Tensor) -> torch.Tensor:
        """Return the actions that ask for joint angles (N, J), (N, J)."""
        return (joint_pos - self.default_joint_pos) / self._action_scale

    def draw_begin(
        self, start: torch.Tensor, random: UniformBuffer
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return qpos (N, 7 + J) and qvel (N, 6 + J) near the keyframes `start`, (N,).

        Takes the columns `joint` and `velocity`, on terrain also `yaw`.
        """
        frames, n = self._keyframes, len(start)
        noise = self._config.joint_noise
        joint_pos = frames.joint_pos[start] + scale_to(random["joint"], -noise, noise)
        num_joints = joint_pos.shape[1]
        qpos = torch.zeros(n, 7 + num_joints, device=start.device)
        pitch = frames.pitch[start]
        yaw = torch.zeros_like(pitch)
        qpos[:, 2] = SPAWN_CLEARANCE - self._kinematics.lowest_foot(pitch, joint_pos)
        if self._ground:  # on the platform in the middle, with any heading
            yaw = scale_to(random["yaw"][:, 0], -math.pi, math.pi)
            qpos[:, 2] += self._ground.spawn_height
        qpos[:, 3:7] = rotations.quat_from_pitch_yaw(pitch, yaw)
        qpos[:, 7:] = joint_pos
        qvel = torch.zeros(n, 6 + num_joints, device=start.device)
        speed = self._config.velocity_noise
        qvel[:, :2] = scale_to(random["velocity"], -speed, speed)
        return qpos, qvel

    def at_rest(self, speeds: list[float]) -> View:
        """Return what robots at rest would observe: each keyframe with each command.

        Args:
            speeds: G commands v_x, m/s.

        Returns:
            S * G robots, the commands of the first skill first; other commands ask for nothing, 0.
        """
        device = self._keyframes.height.device
        count = len(self._keyframes.height)
        skill = torch.arange(count, device=device).repeat_interleave(len(speeds))
        command = torch.zeros(len(skill), 3, device=device)
        command[:, 0] = torch.tensor(speeds, device=device).repeat(count)
        robot = RobotState.at_rest(self._keyframes, skill, self._geoms)
        task = Task.of(command, skill, skill, Asked.nothing(self._widths, command))
        action = self.holding(robot.joint_pos)
        physics = self._physics.expand(len(skill), -1)
        return View(robot, robot, task, self._keyframes, self.default_joint_pos, action, physics)
