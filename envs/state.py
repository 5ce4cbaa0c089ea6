"""What the robot does, in words: named quantities read from the simulation, and the task.

Frames: _w world, _b base, _h heading (the world rotated by the base's yaw). All memory of the
environment lives here; rewards, observations and terminations are functions of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import SimpleNamespace

import torch

from kiras_rl.config import ConfigError
from kiras_rl.envs import rotations
from kiras_rl.envs.ground import Ground
from kiras_rl.envs.kinematics import FootKinematics
from kiras_rl.envs.memory import Memory
from kiras_rl.envs.model import SensorLayout
from kiras_rl.envs.simulation.base import Simulation
from kiras_rl.robots.robot import Robot

STANDING = 0.1  # m/s or rad/s; a smaller command asks to stand
AT_LIMIT = 0.999  # of a torque's limit; the rest is rounding
CONTACT_FORCE = 1.0  # N; a foot that presses harder than this stands
PATCH_SPACING = 0.1  # m between the points whose mean is the ground under the base
AHEAD = (0.0, 0.05, 0.1)  # m before a foot: the highest ground there is what a step has to clear
AROUND = ((0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))  # a foot, in its reach
SCAN_SHAPE = (9, 7)  # points of the height scan, forward and to the left [paper: 63]
SCAN_SPACING = 0.1  # m between them


class RobotState:
    """Named quantities of N robots with J joints, F feet, L other penalised geoms.

    `read_step` fills everything after a control step; `read_kinematics` renews what a reset or a
    push changed. Contacts, velocities of the feet and torques keep the values of the step.
    """

    def __init__(
        self,
        sim: Simulation,
        layout: SensorLayout,
        kinematics: FootKinematics,
        ground: Ground | None = None,
    ) -> None:
        """Bind to a simulation; without a `ground` it is flat."""
        self._sim = sim
        self._layout = layout
        self._kinematics = kinematics
        self._ground = ground
        self._patch = grid(3, 3, PATCH_SPACING).to(sim.device)
        self._scan = grid(*SCAN_SHAPE, SCAN_SPACING).to(sim.device)
        self._ahead = torch.tensor([[x, 0.0] for x in AHEAD], device=sim.device)
        self._around = torch.tensor(AROUND, device=sim.device)
        self.read_kinematics()
        self._read_contacts()

    @classmethod
    def at_rest(
        cls, keyframes: Keyframes, skill: torch.Tensor, geoms: tuple[int, int, int]
    ) -> RobotState:
        """Return robots standing still on the ground in the keyframes `skill`, (N,).

        They belong to no simulation: forces and torques, which would take one, are 0.

        Args:
            keyframes: The poses.
            skill: Which of them, (N,).
            geoms: Number of feet, of the base's geoms and of those of thighs and shanks.
        """
        robot = cls.__new__(cls)
        zero = torch.zeros(len(skill), 3, device=skill.device)
        pitch = keyframes.pitch[skill]
        robot.base_quat_w = rotations.quat_from_pitch_yaw(pitch, torch.zeros_like(pitch))
        robot._rotation = rotations.matrix(robot.base_quat_w)
        robot.yaw_rate = torch.zeros_like(pitch)
        feet, base, limbs = (torch.zeros(len(skill), n, device=skill.device) for n in geoms)
        robot.foot_force, robot.base_force, robot.limb_force = feet, base, limbs
        robot.foot_contact = torch.ones_like(feet, dtype=torch.bool)
        robot.foot_stands = robot.foot_contact
        robot.foot_vel_w = zero[:, None].expand(-1, geoms[0], -1)
        robot.base_height = keyframes.height[skill]
        robot.base_lin_vel_b = robot.base_lin_vel_h = robot.base_ang_vel_b = zero
        robot.gravity_b = keyframes.gravity_b[skill]
        robot.roll_pitch = rotations.roll_pitch(robot.gravity_b)
        robot.joint_pos = keyframes.joint_pos[skill]
        robot.joint_vel = torch.zeros_like(robot.joint_pos)
        robot.joint_torque = robot.joint_vel.clone()
        robot.peak_torque = robot.joint_torque
        robot._foot_height = torch.zeros_like(feet)
        robot._foot_forces_w = torch.zeros_like(feet)[:, None, :, None].expand(-1, 1, -1, 3)
        robot.base_pos_w = torch.zeros_like(zero)
        robot.base_pos_w[:, 2] = robot.base_height
        robot._ground = None
        return robot

    def read_step(self) -> None:
        """Read everything after a control step."""
        self.read_kinematics()
        self._read_contacts()

    def read_kinematics(self) -> None:
        """Read what follows from positions and velocities alone."""
        qpos, qvel = self._sim.qpos, self._sim.qvel
        self.base_pos_w = qpos[:, :3]  # (N, 3), m
        self.base_quat_w = qpos[:, 3:7]  # (N, 4)
        self._rotation = rotation = rotations.matrix(self.base_quat_w)  # base to world, (N, 3, 3)
        self.base_height = self._height_above_ground()  # of the base's origin, (N,), m
        self.base_ang_vel_b = qvel[:, 3:6]  # (N, 3), rad/s
        self.base_lin_vel_b = (qvel[:, None, :3] @ rotation).squeeze(1)  # (N, 3), m/s
        self.base_lin_vel_h = rotations.to_heading_frame(rotation, qvel[:, :3])  # (N, 3), m/s
        self.gravity_b = rotations.projected_gravity(rotation)  # (N, 3), unit vector
        self.roll_pitch = rotations.roll_pitch(self.gravity_b)  # (N, 2), rad
        # Rotation about the vertical, (N,), rad/s
        self.yaw_rate = -(self.gravity_b * self.base_ang_vel_b).sum(-1)
        self.joint_pos = qpos[:, 7:]  # (N, J), rad
        self.joint_vel = qvel[:, 6:]  # (N, J), rad/s
        self._foot_height: torch.Tensor | None = None

    @property
    def foot_height(self) -> torch.Tensor:
        """Height of the lowest point of each foot above the ground, (N, F), m."""
        if self._foot_height is None:  # not every step asks for it
            below = self._kinematics.foot_height_b(self.gravity_b, self.joint_pos)
            self._foot_height = self.base_pos_w[:, 2:] + below - self._ground_under_feet()
        return self._foot_height

    @property
    def foot_clearance(self) -> torch.Tensor:
        """Height of each foot above the highest ground under it and AHEAD of it, (N, F), m."""
        if self._ground is None:
            return self.foot_height
        points = self._foot_points()[..., None, :2]
        ahead = rotations.turn(self._ahead, self.yaw)[:, None]  # (N, 1, points, 2)
        around = self._ground.heights((points + ahead).flatten(1, 2)).unflatten(1, (-1, len(AHEAD)))
        return self.foot_height + around[..., 0] - around.amax(dim=-1)

    def ground_drop(self, reach: float) -> torch.Tensor:
        """Return how deep the ground falls within `reach` m around each foot, (N, F), m.

        That is the height under the foot over the lowest of four points around it, at least 0.
        """
        if self._ground is None:
            return torch.zeros_like(self.foot_force)
        points = self._foot_points()[..., None, :2] + reach * self._around
        heights = self._ground.heights(points.flatten(1, 2)).unflatten(1, (-1, len(self._around)))
        return heights[..., 0] - heights.amin(dim=-1)

    @property
    def yaw(self) -> torch.Tensor:
        """Heading of the base, (N,), rad."""
        return rotations.yaw(self._rotation)

    def height_scan(self) -> torch.Tensor:
        """Return how far the base is above SCAN_SHAPE points around it, (N, points), m.

        The points lie SCAN_SPACING apart in the heading frame.
        """
        if self._ground is None:
            return self.base_pos_w[:, 2:].expand(-1, SCAN_SHAPE[0] * SCAN_SHAPE[1])
        points = self.base_pos_w[:, None, :2] + rotations.turn(self._scan, self.yaw)
        return self.base_pos_w[:, 2:] - self._ground.heights(points)

    def _height_above_ground(self) -> torch.Tensor:
        """Return the height above the mean of 3 x 3 points PATCH_SPACING apart, (N,), m."""
        if self._ground is None:
            return self.base_pos_w[:, 2]
        points = self.base_pos_w[:, None, :2] + self._patch
        return self.base_pos_w[:, 2] - self._ground.heights(points).mean(dim=1)

    def _ground_under_feet(self) -> torch.Tensor:
        """Return the height of the ground under each foot, (N, F), m; 0 where it is flat."""
        if self._ground is None:
            return torch.zeros_like(self.base_pos_w[:, :1])
        return self._ground.heights(self._foot_points()[..., :2])

    def _foot_points(self) -> torch.Tensor:
        """Return the centres of the feet in the world, (N, F, 3), m."""
        pos_b = self._kinematics.foot_pos_b(self.joint_pos)
        return self.base_pos_w[:, None] + pos_b @ self._rotation.mT

    def _read_contacts(self) -> None:
        record, layout = self._sim.sensor_record, self._layout
        squared = _squared_norms(record[:, :, layout.forces_w])  # (N, K, geoms), N^2
        # Largest force of the physics steps, so that no short contact is missed, (N, ...), N
        peaks = squared.amax(dim=1).sqrt()
        self._forces = squared
        feet_w = record[:, :, layout.forces_w][..., : 3 * layout.geoms[0]]
        self._foot_forces_w = feet_w.unflatten(-1, (-1, 3))  # (N, K, F, 3), N
        self.foot_force, self.base_force, self.limb_force = peaks.split(layout.geoms, dim=1)
        feet = squared[:, -1, : layout.geoms[0]]
        self.foot_contact = feet > CONTACT_FORCE**2  # (N, F) bool
        # In any of the physics steps: a foot that chatters has not been lifted, (N, F) bool
        self.foot_stands = self.foot_force > CONTACT_FORCE
        last = record[:, -1]
        self.foot_vel_w = last[:, layout.foot_vel_w].unflatten(1, (-1, 3))  # (N, F, 3), m/s
        self.joint_torque = last[:, layout.joint_torque]  # (N, J), N m
        self._torques = record[:, :, layout.joint_torque].abs()  # (N, K, J), N m
        self.peak_torque = self._torques.amax(dim=1)  # of the physics steps, (N, J), N m

    def loads(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the mean forces of the step on all feet, and on trunk and limbs, (N,) each, N."""
        forces = self._forces.sqrt().mean(dim=1)
        feet = self._layout.geoms[0]
        return forces[:, :feet].sum(dim=1), forces[:, feet:].sum(dim=1)

    def side_force(self, friction: float) -> torch.Tensor:
        """Return by how much feet are pushed harder sideways than `friction` allows, (N, F), N.

        That is the largest of |F_xy| - friction |F_z| in the physics steps, at least 0: on a floor
        of this friction a foot slips first, so a wall or an edge is in its way.
        """
        sideways = torch.linalg.vector_norm(self._foot_forces_w[..., :2], dim=-1)
        excess = sideways - friction * self._foot_forces_w[..., 2].abs()
        return excess.clamp(min=0.0).amax(dim=1)

    def saturation(self, limit: torch.Tensor) -> torch.Tensor:
        """Return the share of the physics steps in which a torque is at its limit, (N,).

        Args:
            limit: (J,), N m.
        """
        return (self._torques >= AT_LIMIT * limit).any(dim=2).float().mean(dim=1)


class Asked(SimpleNamespace):
    """What the terms of `env.commands.terms` ask for, one attribute a term, (N, k) each."""

    @classmethod
    def nothing(cls, widths: Mapping[str, int], like: torch.Tensor) -> Asked:
        """Return zeros for every row of a tensor."""
        return cls(**{name: like.new_zeros(len(like), k) for name, k in widths.items()})

    def __getitem__(self, name: str) -> torch.Tensor:
        """Return what a term asks for by its name in the YAML, (N, k).

        Raises:
            ConfigError: No such term is configured.
        """
        try:
            return getattr(self, name)
        except AttributeError:
            known = ", ".join(vars(self)) or "none"
            raise ConfigError(f"env.commands.terms: no '{name}', configured: {known}") from None


@dataclass
class Task:
    """What each world is asked to do.

    Attributes:
        command: v_x, v_y in the heading frame and yaw rate, (N, 3), m/s and rad/s.
        skill: Index of the commanded skill, (N,) int64.
        start: Index of the keyframe that it comes from, (N,) int64: where the episode began, or
            the skill before.
        heading: Heading that the commanded yaw rate holds, (N,), rad; NaN for none, +inf for that
            of the moment.
        terms: What other commands ask for.
    """

    command: torch.Tensor
    skill: torch.Tensor
    start: torch.Tensor
    heading: torch.Tensor
    terms: Asked = field(default_factory=Asked)

    @classmethod
    def of(
        cls,
        command: torch.Tensor,
        skill: torch.Tensor,
        start: torch.Tensor,
        terms: Asked | None = None,
    ) -> Task:
        """Copy commands, skills and starts; no heading is held."""
        heading = torch.full_like(command[:, 0], torch.nan)
        return cls(command.clone(), skill.clone(), start.clone(), heading, terms or Asked())

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return all of it but what other commands ask for."""
        return {name: value for name, value in vars(self).items() if name != "terms"}


@dataclass(frozen=True)
class Keyframes:
    """The keyframes of a robot as tensors, S rows.

    Attributes:
        height: Base height, (S,), m.
        clearance: Height that a foot should clear in a step, (S,), m.
        pitch: Nose down positive, (S,), rad.
        joint_pos: (S, J), rad.
        gravity_b: Projected gravity, (S, 3).
        code: One-hot code of each, (S, S).
    """

    height: torch.Tensor
    clearance: torch.Tensor
    pitch: torch.Tensor
    joint_pos: torch.Tensor
    gravity_b: torch.Tensor
    code: torch.Tensor

    @classmethod
    def of(cls, robot: Robot, device: torch.device) -> Keyframes:
        """Collect the keyframes of a robot."""

        def tensor(values: list) -> torch.Tensor:
            return torch.tensor(values, dtype=torch.float32, device=device)

        pitch = tensor([k.pitch for k in robot.keyframes])
        zero = torch.zeros_like(pitch)
        return cls(
            height=tensor([k.base_height for k in robot.keyframes]),
            clearance=tensor(robot.clearance.tolist()),
            pitch=pitch,
            joint_pos=tensor([list(k.joint_pos) for k in robot.keyframes]),
            gravity_b=torch.stack([torch.sin(pitch), zero, -torch.cos(pitch)], dim=-1),
            code=torch.eye(len(pitch), device=device),
        )


@dataclass(frozen=True)
class Limits:
    """What joints and motors of a robot allow, as tensors, J columns.

    Attributes:
        low: Least joint angles, (J,), rad.
        high: Largest joint angles, (J,), rad.
        velocity: Largest joint velocities, (J,), rad/s.
        torque: Largest torques, (J,), N m.
    """

    low: torch.Tensor
    high: torch.Tensor
    velocity: torch.Tensor
    torque: torch.Tensor

    @classmethod
    def of(cls, robot: Robot, device: torch.device) -> Limits:
        """Collect the limits of a robot."""
        low, high = robot.joint_limits.T
        values = (low, high, robot.velocity_limit, robot.torque_limit)
        return cls(*(torch.tensor(x, dtype=torch.float32, device=device) for x in values))

    def beyond(self, joint_pos: torch.Tensor, margin: float = 0.0) -> torch.Tensor:
        """Return how far angles (..., J) are outside limits that are `margin` narrower, rad."""
        return (joint_pos - joint_pos.clamp(self.low + margin, self.high - margin)).abs()


@dataclass
class Step:
    """One control step as rewards and terminations see it, before resets.

    Attributes:
        robot: The robots after the step.
        stands: Worlds that are told to stand, (N,) bool.
        task: Their tasks.
        keyframes: The skills.
        limits: Of joints and motors.
        target: What the action asked of the joints, before it was clamped to limits, (N, J), rad.
        action: Clipped action of this step, (N, J).
        last_action: Clipped action of the step before, (N, J); in the first step of an episode the
            one that holds the start pose.
        last_joint_vel: Before the step, (N, J), rad/s.
        last_joint_torque: Before the step, (N, J), N m.
        memory: What terms remember of the steps before.
        fresh: Worlds in the first step of an episode, (N,) bool; `delta_torques` is zero there,
            for there is no torque of a step before.
        fallen: Worlds that terminate by failure, (N,) bool; to a termination, those whose physics
            broke.
        weight: Of a robot before randomization, N.
        dt: Duration of the step, s.
    """

    robot: RobotState
    stands: torch.Tensor
    task: Task
    keyframes: Keyframes
    limits: Limits
    target: torch.Tensor
    action: torch.Tensor
    last_action: torch.Tensor
    last_joint_vel: torch.Tensor
    last_joint_torque: torch.Tensor
    memory: Memory
    fresh: torch.Tensor
    fallen: torch.Tensor
    weight: float
    dt: float

    @cached_property
    def moves(self) -> torch.Tensor:
        """Worlds that are told to move, (N,) bool; many terms ask."""
        return ~self.stands


def grid(rows: int, columns: int, spacing: float) -> torch.Tensor:
    """Return points around the origin, x by rows, y by columns, (rows * columns, 2), m."""
    x = spacing * (torch.arange(rows) - (rows - 1) / 2)
    y = spacing * (torch.arange(columns) - (columns - 1) / 2)
    return torch.cartesian_prod(x, y)


def _squared_norms(flat: torch.Tensor) -> torch.Tensor:
    """Return the squared lengths of the vectors in (..., 3 G), as (..., G)."""
    # Written out: a CPU takes several times as long to reduce over three numbers.
    x, y, z = flat.unflatten(-1, (-1, 3)).unbind(-1)
    return x * x + y * y + z * z
