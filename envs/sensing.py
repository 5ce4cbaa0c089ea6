"""What the robot's own sensors say: biased encoders, a tilted IMU, and all of it a little late."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch.nn.functional import normalize

from kiras_rl.envs import rotations
from kiras_rl.envs.model import SensorLayout
from kiras_rl.envs.randomness import UniformBuffer, scale_to
from kiras_rl.envs.simulation.base import Simulation
from kiras_rl.envs.state import RobotState
from kiras_rl.schema import RandomizationConfig


@dataclass
class Sensed:
    """What the robot knows of its own motion, under the names of RobotState.

    Attributes:
        gravity_b: Unit vector of gravity in the frame of the IMU, (N, 3).
        base_ang_vel_b: Angular velocity in the frame of the IMU, (N, 3), rad/s.
        joint_pos: (N, J), rad.
        joint_vel: (N, J), rad/s.
    """

    gravity_b: torch.Tensor
    base_ang_vel_b: torch.Tensor
    joint_pos: torch.Tensor
    joint_vel: torch.Tensor

    @property
    def roll_pitch(self) -> torch.Tensor:
        """Roll and pitch of the IMU, (N, 2), rad."""
        return rotations.roll_pitch(self.gravity_b)


class Sensors:
    """The sensors of N robots; their errors are drawn at a reset and stay for the episode.

    Attributes:
        encoder_bias: What encoders read at angle 0, (N, J), rad.
        imu_tilt: Small rotation from the base to the IMU, (N, 3), rad; none about the vertical.
        gyro_bias: (N, 3), rad/s.
        delay: Age of what is read, (N,) int64, physics steps.
    """

    def __init__(
        self,
        config: RandomizationConfig,
        sim: Simulation,
        layout: SensorLayout,
        random: UniformBuffer,
    ) -> None:
        """Begin with sensors that make no error."""
        self._config, self._sim, self._layout, self._random = config, sim, layout, random
        n, joints, device = sim.num_worlds, sim.model.nu, sim.device
        self.encoder_bias = torch.zeros(n, joints, device=device)
        self.imu_tilt = torch.zeros(n, 3, device=device)
        self.gyro_bias = torch.zeros(n, 3, device=device)
        self.delay = torch.zeros(n, dtype=torch.int64, device=device)
        imu = config.imu_tilt or config.gyro_bias
        self.are_exact = not (config.encoder_bias or imu or config.observation_delay)

    @staticmethod
    def columns(num_joints: int) -> dict[str, int]:
        """Return the random numbers that this class takes each step."""
        return {"encoder_bias": num_joints, "imu_tilt": 2, "gyro_bias": 3, "observation_delay": 1}

    def reset(self, worlds: torch.Tensor) -> None:
        """Draw the errors of some worlds, (N,) bool."""
        config, random = self._config, self._random
        if config.encoder_bias:
            drawn = scale_to(random["encoder_bias"], *config.encoder_bias)
            self.encoder_bias = torch.where(worlds[:, None], drawn, self.encoder_bias)
        if config.imu_tilt:
            drawn = scale_to(random["imu_tilt"], *config.imu_tilt)
            tilt = torch.cat([drawn, torch.zeros_like(drawn[:, :1])], dim=1)
            self.imu_tilt = torch.where(worlds[:, None], tilt, self.imu_tilt)
        if config.gyro_bias:
            drawn = scale_to(random["gyro_bias"], *config.gyro_bias)
            self.gyro_bias = torch.where(worlds[:, None], drawn, self.gyro_bias)
        if config.observation_delay:
            low, high = config.observation_delay
            drawn = scale_to(random["observation_delay"][:, 0], low, high + 1).long()
            self.delay = torch.where(worlds, drawn, self.delay)

    def read(self, robot: RobotState, begun: torch.Tensor) -> Sensed | RobotState:
        """Return what is read now.

        Args:
            robot: The robots.
            begun: Worlds that have just begun, (N,) bool: they have no past to read.
        """
        if self.are_exact:
            return robot
        now = Sensed(robot.gravity_b, robot.base_ang_vel_b, robot.joint_pos, robot.joint_vel)
        if self._config.observation_delay:
            now = self._past(now, begun)
        # Both vectors turn by minus the tilt, of which only the first order counts.
        gravity = now.gravity_b + torch.linalg.cross(now.gravity_b, self.imu_tilt)
        rates = now.base_ang_vel_b + torch.linalg.cross(now.base_ang_vel_b, self.imu_tilt)
        return Sensed(
            gravity_b=normalize(gravity, dim=1),
            base_ang_vel_b=rates + self.gyro_bias,
            joint_pos=now.joint_pos + self.encoder_bias,
            joint_vel=now.joint_vel,
        )

    def _past(self, now: Sensed, begun: torch.Tensor) -> Sensed:
        """Return each world's motion `delay` physics steps ago, from the record of the step."""
        record, layout = self._sim.sensor_record, self._layout
        late = (self.delay > 0) & ~begun
        row = (record.shape[1] - self.delay).clamp(max=record.shape[1] - 1)
        past = record[torch.arange(len(row), device=row.device), row]
        quat, rates, pos, vel = (past[:, part] for part in layout.motion)
        gravity = rotations.projected_gravity(rotations.matrix(quat))
        return Sensed(
            *(
                torch.where(late[:, None], old, new)
                for old, new in zip((gravity, rates, pos, vel), vars(now).values(), strict=True)
            )
        )

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return the errors of the running episodes."""
        return {name: getattr(self, name) for name in STATE}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Go on from a saved state."""
        for name in STATE:
            setattr(self, name, state[name].to(self.delay.device))


STATE = ("encoder_bias", "imu_tilt", "gyro_bias", "delay")
"""Attributes that a reset replaces."""
