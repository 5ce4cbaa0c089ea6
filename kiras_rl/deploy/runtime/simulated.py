"""A robot in C MuJoCo behind the driver's interface: noise, delay, and the curves of its motors.

The only part of the runtime that needs the whole project: MuJoCo, and the robot's folder.
"""

from __future__ import annotations

from collections import deque

import mujoco
import numpy as np

from kiras_rl.deploy.metadata import PolicyMetadata
from kiras_rl.deploy.profile import Profile
from kiras_rl.deploy.runtime.driver import Link
from kiras_rl.deploy.runtime.messages import Flag, Mode
from kiras_rl.robots.robot import load_robot

STEP = 0.001  # s of physics
DELAY = 0.002  # s from an order to its torque
POSITION_NOISE = 0.002  # rad, standard deviations from here
VELOCITY_NOISE = 0.1  # rad/s
TILT_NOISE = 0.005  # of a quaternion's entries
GYRO_NOISE = 0.02  # rad/s
ACCELERATION_NOISE = 0.2  # m/s^2
SETTLE = 1.0  # s that the robot sinks onto the ground before it is handed over

_SITE = "onboard_imu"  # in the base's origin

Action = tuple  # mode, targets, kp and kd of the robot's joints


class Plant:
    """The robot and the ground, stepped by hand.

    Attributes:
        model: MuJoCo's model.
        data: MuJoCo's state.
        torque: What the motors gave in the last step, (J,), N m.
    """

    def __init__(self, metadata: PolicyMetadata, profile: Profile, seed: int = 0) -> None:
        """Lay the robot on the ground, about folded into its lowest posture.

        Args:
            metadata: Of the policy, which names the robot.
            profile: Its profile.
            seed: Of how its legs lie, and of the noise.
        """
        self._robot = load_robot(metadata.robot)
        self._damping = profile.damping
        self._limit = np.array(metadata.torque_limit)
        self._random = np.random.default_rng(seed)
        spec = self._robot.spec(visuals=False)
        for actuator in list(spec.actuators):
            spec.delete(actuator)
        base = spec.body(self._robot.base_body)
        base.add_site(name=_SITE)
        spec.add_sensor(
            type=mujoco.mjtSensor.mjSENS_ACCELEROMETER,
            objtype=mujoco.mjtObj.mjOBJ_SITE,
            objname=_SITE,
        )
        spec.option.timestep = STEP
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.torque = np.zeros(self.model.nu or len(self._robot.joint_names))
        self._lay(metadata)

    def _lay(self, metadata: PolicyMetadata) -> None:
        lowest = min(metadata.keyframes.values(), key=lambda posture: posture.base_height)
        noise = self._random.uniform(-0.1, 0.1, len(lowest.joint_pos))
        self.data.qpos[2] = 1.5 * lowest.base_height
        self.data.qpos[7:] = np.clip(lowest.joint_pos + noise, *self._robot.joint_limits.T)
        zero = np.zeros(len(lowest.joint_pos))
        for _ in range(round(SETTLE / STEP)):
            self.step((Mode.DAMP, zero, zero, zero))

    def step(self, action: Action) -> None:
        """Advance by STEP with a mode and the targets, kp and kd of the joints, (J,) each."""
        mode, target, kp, kd = action
        velocity = self.data.qvel[6:]
        if mode in (Mode.SERVO, Mode.HOLD):
            asked = kp * (target - self.data.qpos[7:]) - kd * velocity
        else:
            asked = -self._damping * velocity if mode == Mode.DAMP else np.zeros_like(velocity)
        motor, limit = self._robot.motor, self._limit
        asked = np.clip(asked, -motor.largest_torque(-velocity), motor.largest_torque(velocity))
        self.torque = np.clip(asked, -limit, limit)
        self.data.qfrc_applied[6:] = self.torque
        mujoco.mj_step(self.model, self.data)

    def measure(self, reading: np.ndarray) -> None:
        """Write what the sensors tell into a READING, shape ()."""
        data, noise, joints = self.data, self._random.normal, len(self.torque)
        reading["joint_pos"][:joints] = data.qpos[7:] + noise(0, POSITION_NOISE, joints)
        reading["joint_vel"][:joints] = data.qvel[6:] + noise(0, VELOCITY_NOISE, joints)
        reading["torque"][:joints] = self.torque
        quat = data.qpos[3:7] + noise(0, TILT_NOISE, 4)
        reading["quat"] = quat / np.linalg.norm(quat)
        reading["gyro"] = data.qvel[3:6] + noise(0, GYRO_NOISE, 3)
        reading["acc"] = data.sensordata[:3] + noise(0, ACCELERATION_NOISE, 3)


class SimulatedRobot(Link):
    """A plant that advances by one driver's period whenever it is sent something."""

    def __init__(self, plant: Plant, rate: float) -> None:
        """Take over a plant.

        Args:
            plant: The robot.
            rate: Of the driver, Hz.
        """
        self.plant = plant
        self._steps = round(1 / (rate * STEP))
        joints = len(plant.torque)
        nothing = np.zeros(joints)
        rest: Action = (Mode.OFF, nothing, nothing, nothing)
        self._queue = deque([rest] * (round(DELAY / STEP) + 1), round(DELAY / STEP) + 1)
        self._calibrated = False

    def receive(self, reading: np.ndarray, now: int) -> bool:
        """See Link."""
        self.plant.measure(reading)
        reading["flags"] = Flag.CALIBRATED if self._calibrated else 0
        return True

    def send(self, mode: Mode, order: np.ndarray, now: int) -> None:
        """See Link."""
        joints = len(self.plant.torque)
        self._calibrated |= mode == Mode.CALIBRATE
        action = (mode, order["target"][:joints], order["kp"][:joints], order["kd"][:joints])
        for _ in range(self._steps):
            self._queue.append(action)
            self.plant.step(self._queue[0])
