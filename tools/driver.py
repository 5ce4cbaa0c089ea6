"""One robot in C MuJoCo under an onboard policy: what a real robot would do, without torch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from kiras_rl.deploy.metadata import Posture
from kiras_rl.deploy.policy import OnboardPolicy, PolicyError, PolicyMetadata, projected_gravity
from kiras_rl.robots.robot import Robot, RobotError, load_robot

_CONTACT_FORCE = 1.0  # N; less is a graze
_FALL_COSINE = np.cos(np.deg2rad(60.0))  # gravity this far from the posture: not recoverable
_CLEARANCE = 0.002  # m between the lowest foot and the ground at a reset


@dataclass(frozen=True)
class Segment:
    """Part of a script: a skill and a command for some seconds.

    `command` is v_x, v_y in m/s and yaw rate in rad/s.
    """

    duration: float
    skill: str
    command: tuple[float, float, float]


@dataclass(frozen=True)
class Sample:
    """What happened in one control step; arrays over feet (F,) and joints (J,)."""

    time: float
    """Seconds since the driver was made."""
    base_height: float
    """Base origin above the ground, m."""
    pitch: float
    """Positive = nose down, rad."""
    roll: float
    """Positive = left side up, rad."""
    lin_vel: np.ndarray
    """Base velocity along heading, to the left, up; (3,), m/s."""
    yaw_rate: float
    """About the vertical, rad/s."""
    foot_contact: np.ndarray
    """Feet that press on the ground at the end of the step, (F,) bool."""
    joint_torque: np.ndarray
    """Mean over the substeps, (J,), N m."""
    joint_pos: np.ndarray
    """Angles, (J,), rad."""
    skill: int
    """Index of the commanded skill."""
    command: np.ndarray
    """v_x, v_y, yaw rate; (3,), m/s and rad/s."""
    fallen: bool
    """The base presses on the ground, or leans 60 degrees away from its posture."""
    qpos: np.ndarray
    """Full configuration, for drawing, (7 + J,)."""


@dataclass(frozen=True)
class Trace:
    """Samples of a script, stacked over T steps, and what is needed to read them.

    The arrays are the fields of `Sample` with a leading T.
    """

    robot: str
    skills: tuple[str, ...]
    feet: tuple[str, ...]
    rate: float
    """Samples a second."""
    time: np.ndarray
    base_height: np.ndarray
    pitch: np.ndarray
    roll: np.ndarray
    lin_vel: np.ndarray
    yaw_rate: np.ndarray
    foot_contact: np.ndarray
    joint_torque: np.ndarray
    joint_pos: np.ndarray
    skill: np.ndarray
    command: np.ndarray
    fallen: np.ndarray
    qpos: np.ndarray
    segment: np.ndarray
    """Index of the script's segment, (T,)."""

    def save(self, path: str | Path) -> None:
        """Write all arrays and names to one .npz file."""
        np.savez_compressed(path, **{item.name: getattr(self, item.name) for item in fields(self)})


class Driver:
    """A simulated robot on flat ground, commanded through its onboard policy.

    Gains and torque limits are those of the policy file: the robot is driven as it was in training,
    whatever its folder says today.

    Attributes:
        policy: The policy that drives.
        robot: The robot that the policy names.
        spec: The scene as a document: what a viewer adds its own things to, on a copy.
        model: The simulated scene.
        data: Its state.
        substeps: Physics steps in a control step.
    """

    def __init__(self, policy: OnboardPolicy) -> None:
        """Build the scene and stand in the first skill's posture, commanded to stand.

        Raises:
            RobotError: If the robot of the policy is unknown or has other joints.
        """
        self.policy = policy
        meta = self.metadata
        self.robot = load_robot(meta.robot)
        _check_joints(self.robot, meta)
        self.spec = self.robot.spec()
        self.model = _build_model(self.spec, meta)
        self.data = mujoco.MjData(self.model)
        self.substeps = round(1 / (meta.control_rate * self.model.opt.timestep))
        self._feet = np.array([self.model.geom(name).id for name in self.robot.foot_geoms])
        self._base = np.array([self.model.geom(name).id for name in self.robot.base_geoms])
        self._gravity = np.array([_gravity_at(meta.keyframes[s].pitch) for s in meta.skills])
        self._steps = 0
        self._skill, self._command = 0, np.zeros(3)
        self.reset(0)

    @property
    def metadata(self) -> PolicyMetadata:
        """Description of the policy."""
        return self.policy.metadata

    @property
    def time(self) -> float:
        """Seconds since the driver was made; resets do not turn it back."""
        return self._steps / self.metadata.control_rate

    def set_task(self, skill: str | int, command: ArrayLike) -> None:
        """Set what the next steps ask for.

        Args:
            skill: Name or index of a skill.
            command: v_x, v_y in m/s and yaw rate in rad/s, (3,).

        Raises:
            PolicyError: If the skill is unknown or the command has another length.
        """
        index = self.policy.skill_index(skill)
        self.set_command(command)
        self._previous, self._skill = self._skill, index

    def set_command(self, command: ArrayLike) -> None:
        """Change the command alone, (3,): a change of skill that is under way stays one.

        Raises:
            PolicyError: If the command has another length.
        """
        command = np.asarray(command, np.float64)
        if command.shape != (3,):
            raise PolicyError(f"a command is v_x, v_y and yaw rate, not {command.tolist()}")
        self._command = command

    def reset(self, skill: str | int) -> None:
        """Put the robot at rest into the posture of a skill, with its feet just above the ground.

        The task stays as it is.
        """
        index = self.policy.skill_index(skill)
        posture = self.metadata.keyframes[self.metadata.skills[index]]
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:7] = (0, 0, posture.base_height, *_pitched(posture.pitch))
        self.data.qpos[7:] = posture.joint_pos
        mujoco.mj_kinematics(self.model, self.data)
        lowest = self.data.geom_xpos[self._feet, 2].min() - self.robot.foot_radius
        self.data.qpos[2] += _CLEARANCE - lowest
        self.data.ctrl[:] = posture.joint_pos
        mujoco.mj_forward(self.model, self.data)
        self.policy.reset(posture.joint_pos)
        self._previous = index

    def take_over(self, other: Driver) -> None:
        """Go on from another driver's state: a new policy for the same robot in full stride.

        Raises:
            RobotError: If the other robot has other joints.
        """
        _check_joints(other.robot, self.metadata)
        self.data.qpos[:], self.data.qvel[:] = other.data.qpos, other.data.qvel
        self.data.ctrl[:] = other.data.ctrl
        mujoco.mj_forward(self.model, self.data)
        self.policy.reset(other.data.ctrl)
        self._steps = other._steps

    def push(self, velocity: ArrayLike) -> None:
        """Add a velocity to the base, (3,), world frame, m/s."""
        self.data.qvel[:3] += np.asarray(velocity, np.float64)

    @property
    def posture(self) -> Posture:
        """The posture that is asked for."""
        return self.metadata.keyframes[self.metadata.skills[self._skill]]

    def step(self, after_substep: Callable[[], None] | None = None) -> Sample:
        """Run one control period and return how it ended.

        Args:
            after_substep: Called after every physics step, for who watches in slow motion.
        """
        data = self.data
        data.ctrl[:] = self.policy.step(
            joint_pos=data.qpos[7:],
            joint_vel=data.qvel[6:],
            imu_quat=data.qpos[3:7],
            base_ang_vel=data.qvel[3:6],  # of a free joint: in its own frame
            command=self._command,
            skill=self._skill,
        )
        torque = np.zeros(self.model.nu)
        for _ in range(self.substeps):
            mujoco.mj_step(self.model, data)
            torque += data.actuator_force / self.substeps
            if after_substep is not None:
                after_substep()
        self._steps += 1
        return self._sample(torque)

    def _sample(self, torque: np.ndarray) -> Sample:
        qpos, qvel = self.data.qpos.copy(), self.data.qvel
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, qpos[3:7])
        rotation = rotation.reshape(3, 3)  # columns: the base's axes in the world
        vertical = rotation[2]  # the world's z axis in the base frame
        heading = np.arctan2(rotation[1, 0], rotation[0, 0])
        cosine, sine = np.cos(heading), np.sin(heading)
        pressing = self._ground_force() > _CONTACT_FORCE
        return Sample(
            time=self.time,
            base_height=float(qpos[2]),
            pitch=float(np.arcsin(np.clip(-vertical[0], -1, 1))),
            roll=float(np.arctan2(vertical[1], vertical[2])),
            lin_vel=np.array(
                [cosine * qvel[0] + sine * qvel[1], cosine * qvel[1] - sine * qvel[0], qvel[2]]
            ),
            yaw_rate=float(vertical @ qvel[3:6]),
            foot_contact=pressing[self._feet],
            joint_torque=torque,
            joint_pos=qpos[7:],
            skill=self._skill,
            command=self._command.copy(),
            fallen=bool(pressing[self._base].any() or self._leans(qpos[3:7])),
            qpos=qpos,
        )

    def _ground_force(self) -> np.ndarray:
        """Contact force of every geom, (G,), N; a robot's geoms collide with the ground only."""
        forces, wrench = np.zeros(self.model.ngeom), np.zeros(6)
        for index, pair in enumerate(self.data.contact.geom):
            mujoco.mj_contactForce(self.model, self.data, index, wrench)
            forces[pair] += np.linalg.norm(wrench[:3])
        return forces

    def _leans(self, quat: np.ndarray) -> bool:
        """Whether gravity is far from the posture asked for and from the one before it."""
        wanted = self._gravity[[self._skill, self._previous]]
        return bool((wanted @ projected_gravity(quat)).max() < _FALL_COSINE)


def record(driver: Driver, script: Sequence[Segment]) -> Trace:
    """Run a script and keep every sample; a fallen robot starts again in its skill's posture."""
    samples, segments = [], []
    driver.reset(script[0].skill)
    for number, segment in enumerate(script):
        driver.set_task(segment.skill, segment.command)
        for _ in range(max(1, round(segment.duration * driver.metadata.control_rate))):
            sample = driver.step()
            samples.append(sample)
            segments.append(number)
            if sample.fallen:
                driver.reset(segment.skill)
    stacked = {
        item.name: np.array([getattr(sample, item.name) for sample in samples])
        for item in fields(Sample)
    }
    meta = driver.metadata
    return Trace(
        robot=meta.robot,
        skills=meta.skills,
        feet=driver.robot.foot_geoms,
        rate=meta.control_rate,
        segment=np.array(segments),
        **stacked,
    )


def default_script(
    metadata: PolicyMetadata, command: tuple[float, float, float] = (0.3, 0.0, 0.0)
) -> list[Segment]:
    """Stand for a second, then every skill of the policy for four, one after the other."""
    stand = Segment(1.0, metadata.skills[0], (0.0, 0.0, 0.0))
    return [stand, *(Segment(4.0, skill, command) for skill in metadata.skills)]


def parse_script(text: str, metadata: PolicyMetadata) -> list[Segment]:
    """Read a script such as `walk:4:0.3,crawl:4:0.3:0:0.2`.

    Each part is skill:seconds:v_x, and may go on with :v_y and :yaw_rate.

    Raises:
        PolicyError: If a part cannot be read or names a skill that the policy does not have.
    """
    return [_parse_segment(part.strip(), metadata) for part in text.split(",")]


def parse_command(text: str) -> tuple[float, float, float]:
    """Read `v_x[,v_y[,yaw_rate]]`, m/s and rad/s; what is left out is zero.

    Raises:
        PolicyError: If these are not one to three finite numbers.
    """
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not 1 <= len(numbers) <= 3 or not np.isfinite(numbers).all():
        raise PolicyError(f"a command is v_x[,v_y[,yaw_rate]], e.g. 0.3 or 0.3,0,0.5, not '{text}'")
    v_x, v_y, yaw_rate = [*numbers, 0.0, 0.0][:3]
    return v_x, v_y, yaw_rate


def _parse_segment(part: str, metadata: PolicyMetadata) -> Segment:
    skill, _, rest = part.partition(":")
    duration, _, command = rest.partition(":")
    try:
        seconds = float(duration)
    except ValueError:
        seconds = -1.0
    if not 0 < seconds < np.inf or not command:
        raise PolicyError(
            f"a script's part is skill:seconds:v_x[:v_y[:yaw_rate]], e.g. "
            f"{metadata.skills[0]}:4:0.3, not '{part}'"
        )
    if skill not in metadata.skills:
        raise PolicyError(
            f"unknown skill '{skill}' in the script; this policy has: {', '.join(metadata.skills)}"
        )
    return Segment(seconds, skill, parse_command(command.replace(":", ",")))


def _check_joints(robot: Robot, metadata: PolicyMetadata) -> None:
    if robot.joint_names != metadata.joint_names:
        raise RobotError(
            f"the policy was trained for the joints {', '.join(metadata.joint_names)}, "
            f"but robot '{robot.name}' has {', '.join(robot.joint_names)}"
        )


def _build_model(spec: mujoco.MjSpec, metadata: PolicyMetadata) -> mujoco.MjModel:
    model = spec.compile()
    limit = np.array(metadata.torque_limit)
    model.actuator_gainprm[:, 0] = metadata.kp
    model.actuator_biasprm[:, 1] = -np.array(metadata.kp)
    model.actuator_biasprm[:, 2] = -np.array(metadata.kd)
    model.actuator_forcerange[:] = np.stack([-limit, limit], axis=1)
    return model


def _pitched(pitch: float) -> tuple[float, float, float, float]:
    return float(np.cos(pitch / 2)), 0.0, float(np.sin(pitch / 2)), 0.0


def _gravity_at(pitch: float) -> np.ndarray:
    return projected_gravity(np.array(_pitched(pitch)))
