"""What the robot's own sensors say: biased encoders, a tilted IMU, and all of it a little late."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch.nn.functional import normalize

from kiras_rl.config import ConfigError
from kiras_rl.envs import rotations
from kiras_rl.envs.model import SensorLayout
from kiras_rl.envs.randomness import UniformBuffer
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
        errors: One row per world, (N, E): biases of the encoders, J, rad; rotation from the base
            to the IMU, 3, rad, small and none about the vertical; biases of the gyroscope, 3,
            rad/s; age of what is read, 1, physics steps and a fraction that does not count.
    """

    def __init__(
        self,
        config: RandomizationConfig,
        sim: Simulation,
        layout: SensorLayout,
        random: UniformBuffer,
    ) -> None:
        """Begin with sensors that make no error.

        Raises:
            ConfigError: Observations that are later than a control step.
        """
        steps = sim.sensor_record.shape[1]
        if config.observation_delay and config.observation_delay[1] > steps:
            raise ConfigError(
                f"env.randomization.observation_delay={list(config.observation_delay)}: at most a "
                f"control step, which is {steps} physics steps (sim.substeps)"
            )
        self._config, self._sim, self._layout, self._random = config, sim, layout, random
        joints, none = sim.model.nu, (0.0, 0.0)
        delay = config.observation_delay
        tilt = config.imu_tilt or none
        ranges = [
            *[config.encoder_bias or none] * joints,
            *(tilt, tilt, none),
            *[config.gyro_bias or none] * 3,
            (delay[0], delay[1] + 1) if delay else none,
        ]
        self.are_exact = not any(low or high for low, high in ranges)
        self._low, high = torch.tensor(ranges, dtype=torch.float32, device=sim.device).T
        self._span = high - self._low
        self.errors = torch.zeros(sim.num_worlds, len(ranges), device=sim.device)

    @staticmethod
    def columns(num_joints: int) -> dict[str, int]:
        """Return the random numbers that this class takes each step."""
        return {"sensors": num_joints + 7}

    @property
    def encoder_bias(self) -> torch.Tensor:
        """What encoders read at angle 0, (N, J), rad."""
        return self.errors[:, :-7]

    def reset(self, worlds: torch.Tensor, randomized: torch.Tensor) -> None:
        """Draw the errors of some worlds, (N,) bool; none where not `randomized`, (N, 1) bool."""
        if not self.are_exact:
            drawn = (self._low + self._span * self._random["sensors"]) * randomized
            self.errors = torch.where(worlds[:, None], drawn, self.errors)

    def read(self, robot: RobotState, begun: torch.Tensor) -> Sensed:
        """Return what is read now.

        Args:
            robot: The robots.
            begun: Worlds that have just begun, (N,) bool: they have no past to read.
        """
        quat, rates, joint_pos, joint_vel = self._motion(robot, begun)
        gravity = rotations.projected_gravity(rotations.matrix(quat))
        tilt, gyro_bias = self.errors[:, -7:-4], self.errors[:, -4:-1]
        # Both vectors turn by minus the tilt, of which only the first order counts.
        gravity = normalize(gravity + torch.linalg.cross(gravity, tilt), dim=1)
        rates = rates + torch.linalg.cross(rates, tilt) + gyro_bias
        return Sensed(gravity, rates, joint_pos + self.encoder_bias, joint_vel)

    def _motion(self, robot: RobotState, begun: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return quaternion, rates, joint angles and velocities as old as each world's sensors."""
        now = (robot.base_quat_w, robot.base_ang_vel_b, robot.joint_pos, robot.joint_vel)
        if self._layout.motion is None:  # nothing is late
            return now
        record = self._sim.sensor_record  # its last row is a physics step older than now
        steps = record.shape[1]
        age = self.errors[:, -1].long()
        row = (steps - age).clamp(max=steps - 1)
        past = record[torch.arange(len(row), device=row.device), row]
        late = (age > 0) & ~begun
        motion = torch.where(late[:, None], past[:, self._layout.motion], torch.cat(now, dim=1))
        return motion.split([part.shape[1] for part in now], dim=1)

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return the errors of the running episodes."""
        return {"errors": self.errors}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Go on from a saved state."""
        self.errors = state["errors"].to(self.errors.device)
