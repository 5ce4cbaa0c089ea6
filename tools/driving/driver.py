"""One robot in C MuJoCo under an onboard policy: what a real robot would do, without torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from kiras_rl.deploy.metadata import Posture
from kiras_rl.deploy.policy import OnboardPolicy, PolicyError, PolicyMetadata, projected_gravity
from kiras_rl.envs.terrains import CROSSED
from kiras_rl.tools.driving.ground import FLAT, Terrain, Tile, ground_height, terrain_of
from kiras_rl.tools.shared.policy_files import check_joints, robot_of

_CONTACT_FORCE = 1.0  # N; less is a graze
_FALL_COSINE = np.cos(np.deg2rad(60.0))  # gravity this far from the posture: not recoverable
_CLEARANCE = 0.002  # m between the lowest foot and the ground at a reset


@dataclass(frozen=True)
class Sample:
    """What happened in one control step; arrays over feet (F,) and joints (J,)."""

    time: float
    """Seconds since the driver was made."""
    base_height: float
    """Base origin above the ground under it, m."""
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
    crossed: bool
    """It has come to the end of its tile; never on flat ground, which has none."""
    qpos: np.ndarray
    """Full configuration, for drawing, (7 + J,)."""


class Driver:
    """A simulated robot, commanded through its onboard policy; on flat ground until told otherwise.

    Gains and torque limits are those of the policy file: the robot is driven as it was in training,
    whatever its folder says today.

    Attributes:
        policy: The policy that drives.
        robot: The robot that the policy names.
        tile: The ground that it is on.
        spec: The scene as a document: what a viewer adds its own things to, on a copy.
        model: The simulated scene; another one after `show`.
        data: Its state.
        substeps: Physics steps in a control step.
    """

    def __init__(self, policy: OnboardPolicy, terrain: Terrain | None = None) -> None:
        """Build the scene and stand in the first skill's posture, commanded to stand.

        Args:
            policy: The policy that drives.
            terrain: The tiles that `show` chooses from; None for those of the policy.

        Raises:
            RobotError: If the robot of the policy is unknown or has other joints.
        """
        self.policy = policy
        meta = self.metadata
        self.robot = robot_of(meta)
        self._terrain = terrain
        self._build(FLAT)
        self._gravity = np.array([_gravity_at(meta.keyframes[s].pitch) for s in meta.skills])
        self._steps = 0
        self._skill, self._command = 0, np.zeros(3)
        self.reset(0)

    def _build(self, tile: Tile) -> None:
        spec = self.robot.spec()
        if not tile.is_flat:
            self.terrain.build(spec, tile)
        self.tile, self.spec = tile, spec
        self.model = spec.compile()
        rate, option = self.metadata.control_rate, self.model.opt
        self.substeps = round(1 / (rate * option.timestep))
        option.timestep = 1 / (rate * self.substeps)  # another one where the policy's rate asks it
        self.data = mujoco.MjData(self.model)
        self._feet = np.array([self.model.geom(name).id for name in self.robot.foot_geoms])
        self._base = np.array([self.model.geom(name).id for name in self.robot.base_geoms])

    @property
    def terrain(self) -> Terrain:
        """The tiles to choose from; read when they are first asked for."""
        if self._terrain is None:
            self._terrain = terrain_of(self.metadata)
        return self._terrain

    @property
    def scene(self) -> tuple[str, Tile, Terrain | None]:
        """What it looks like: robot and ground. Equal scenes look the same."""
        flat = self.tile.is_flat
        return (self.robot.name, FLAT, None) if flat else (self.robot.name, self.tile, self.terrain)

    def show(self, kind: str, level: int = 0, variant: int = 0) -> None:
        """Put a tile under the robot, and the robot on its platform in the posture asked for.

        Args:
            kind: Type of terrain; "flat" is the endless floor.
            level: Difficulty, from 0.
            variant: Which of the tiles of this type and level, from 0.

        Raises:
            ConfigError: If there is no such tile, or the configuration holds what cannot be.
        """
        tile = Tile(kind, level, variant)
        self.terrain.check(tile)
        self._build(tile)
        self.reset(self._skill)

    def ground_height(self, place: ArrayLike) -> float:
        """Return the height of the ground under a base at a place, (2,), m."""
        if self.tile.is_flat:
            return 0.0
        return ground_height(self.model, self.data, np.asarray(place))

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

        That is in the middle of the tile, on its platform.

        The task stays as it is.
        """
        index = self.policy.skill_index(skill)
        posture = self.metadata.keyframes[self.metadata.skills[index]]
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:7] = (0, 0, posture.base_height, *_pitched(posture.pitch))
        self.data.qpos[7:] = posture.joint_pos
        mujoco.mj_kinematics(self.model, self.data)
        lowest = self.data.geom_xpos[self._feet, 2].min() - self.robot.foot_radius
        self.data.qpos[2] += _CLEARANCE - lowest + self.ground_height((0.0, 0.0))
        self.data.ctrl[:] = posture.joint_pos
        mujoco.mj_forward(self.model, self.data)
        self.policy.reset(posture.joint_pos)
        self._previous = index

    def take_over(self, other: Driver) -> None:
        """Go on from another driver's state: a new policy for the same robot in full stride.

        Both have to be on the same ground.

        Raises:
            RobotError: If the other robot has other joints.
        """
        check_joints(other.robot, self.metadata)
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
            base_height=float(qpos[2]) - self.ground_height(qpos[:2]),
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
            crossed=bool(not self.tile.is_flat and np.abs(qpos[:2]).max() > CROSSED),
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


def _pitched(pitch: float) -> tuple[float, float, float, float]:
    return float(np.cos(pitch / 2)), 0.0, float(np.sin(pitch / 2)), 0.0


def _gravity_at(pitch: float) -> np.ndarray:
    return projected_gravity(np.array(_pitched(pitch)))
