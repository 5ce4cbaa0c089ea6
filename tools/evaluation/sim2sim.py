"""A second simulator for a policy file: other contacts, smaller steps, the motors outside of it.

It shares the robot's MJCF with the training and nothing else. C MuJoCo steps at 1 ms with an
elliptic friction cone. The PD controller and the motors are computed here and act as joint
torques; the code that runs on the robot closes the loop.

Letters: T physics steps, J joints, F feet.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from kiras_rl.deploy.policy import LARGEST_READING, OnboardPolicy
from kiras_rl.evaluation.strides import Walk, describe
from kiras_rl.robots.robot import Keyframe, Robot

TIMESTEP = 0.001  # s
IMPRATIO = 10.0  # friction is this much stiffer than the normal force: feet that stand do not creep
ITERATIONS = 50  # at most, of the Newton solver and of its line search
TOLERANCE = 1e-10

CONTACT_FORCE = 1.0  # N of normal force; more is a contact
MAX_TILT = np.deg2rad(60.0)  # from the keyframe; more is a fall

JOINT_NOISE = 0.05  # rad; the start is off the keyframe by at most this
FRICTION = (0.5, 1.0)
DURATION = 8.0  # s of a walk
SETTLE = 2.0  # s of it that do not count
STANDING = 10.0  # s of standing, which all count
SEED = 2026


def motor_torque(robot: Robot, asked: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Return what the motors give of the torques that the controller asks for.

    Along the motion a motor's torque falls with the speed. Against it, it grows: only the torque
    limit holds it.

    Args:
        robot: With the motors and their limits.
        asked: Torques of the PD controller, (..., J), N m.
        velocity: Of the joints, (..., J), rad/s.

    Returns:
        Torques, (..., J), N m.
    """
    most = robot.motor.largest_torque(velocity)
    least = -robot.motor.largest_torque(-velocity)
    within = np.minimum(np.maximum(asked, least), most)
    return np.minimum(np.maximum(within, -robot.torque_limit), robot.torque_limit)


@dataclass(frozen=True, eq=False)
class Start:
    """How a trial begins, and on which ground.

    Attributes:
        keyframe: Of the skill.
        joint_pos: Joint angles, (J,), rad.
        heading: rad.
        friction: Between robot and ground.
        command: v_x, m/s.
    """

    keyframe: Keyframe
    joint_pos: np.ndarray
    heading: float
    friction: float
    command: float


def draw_start(keyframe: Keyframe, number: int, commands: Sequence[float]) -> Start:
    """Draw trial `number` of a skill; the same number gives the same trial.

    Args:
        keyframe: Of the skill.
        number: From 0.
        commands: v_x to choose from, m/s.
    """
    random = np.random.default_rng((SEED, number))
    noise = random.uniform(-JOINT_NOISE, JOINT_NOISE, len(keyframe.joint_pos))
    return Start(
        keyframe=keyframe,
        joint_pos=keyframe.joint_pos + noise,
        heading=random.uniform(-np.pi, np.pi),
        friction=random.uniform(*FRICTION),
        command=random.choice(commands),
    )


class Simulator:
    """One robot on flat ground.

    Attributes:
        robot: The robot.
        data: MuJoCo's state.
        asked: Torques that the controller asked for in the last step, (J,), N m.
        torque: What the motors gave, (J,), N m.
        foot_force: Normal force of the ground on each foot, (F,), N.
        has_fallen: Whether the base touched the ground, or leant too far, or the physics broke.
    """

    def __init__(self, robot: Robot) -> None:
        """Compile the robot's scene without its actuators."""
        self.robot = robot
        self.model = _compile(robot)
        self.data = mujoco.MjData(self.model)
        self.asked = self.torque = np.zeros(len(robot.joint_names))
        self.foot_force = np.zeros(len(robot.foot_geoms))
        self.has_fallen = False
        self._base = self.model.body(robot.base_body).id
        self._feet = [self.model.geom(name).id for name in robot.foot_geoms]
        self._base_geoms = [self.model.geom(name).id for name in robot.base_geoms]
        self._up = np.array([0.0, 0.0, 1.0])

    def place(self, start: Start) -> None:
        """Put the robot at rest on the ground, its lowest foot touching it."""
        model, data = self.model, self.data
        mujoco.mj_resetData(model, data)
        model.geom_friction[model.geom_bodyid > 0, 0] = start.friction
        half = start.heading / 2
        turn = np.array([np.cos(half), 0.0, 0.0, np.sin(half)])
        data.qpos[:3] = 0.0, 0.0, start.keyframe.base_height
        mujoco.mju_mulQuat(data.qpos[3:7], turn, start.keyframe.quat)
        data.qpos[7:] = start.joint_pos
        mujoco.mj_kinematics(model, data)
        data.qpos[2] -= self.foot_height.min()
        self.has_fallen = False
        pitch = start.keyframe.pitch
        self._up = np.array([-np.sin(pitch), 0.0, np.cos(pitch)])  # in the base frame

    def step(self, target: np.ndarray) -> None:
        """Advance by TIMESTEP with joint targets (J,), rad."""
        data, robot = self.data, self.robot
        velocity = data.qvel[6:]
        self.asked = robot.kp * (target - data.qpos[7:]) - robot.kd * velocity
        self.torque = motor_torque(robot, self.asked, velocity)
        data.qfrc_applied[6:] = self.torque
        begun = data.time
        mujoco.mj_step(self.model, data)
        broke = data.time <= begun  # MuJoCo begins anew where its numbers explode
        broke |= np.abs(data.qvel).max() > LARGEST_READING
        force = self._normal_forces()
        self.foot_force = force[self._feet]
        touches = force[self._base_geoms].sum() > CONTACT_FORCE
        leans = data.xmat[self._base, 6:] @ self._up < np.cos(MAX_TILT)
        self.has_fallen = bool(touches or leans or broke)

    @property
    def foot_height(self) -> np.ndarray:
        """Height of the lowest point of each foot above the ground, (F,), m."""
        return self.data.geom_xpos[self._feet, 2] - self.robot.foot_radius

    def _normal_forces(self) -> np.ndarray:
        """Return the normal force of the ground on every geom, N."""
        contact = self.data.contact
        active = contact.efc_address >= 0
        force = self.data.efc_force[contact.efc_address[active]]  # first row of an elliptic cone
        geoms = contact.geom[active].max(axis=1)  # the floor is geom 0
        return np.bincount(geoms, weights=force, minlength=self.model.ngeom)


def _compile(robot: Robot) -> mujoco.MjModel:
    spec = robot.spec(visuals=False)
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    option = spec.option
    option.timestep = TIMESTEP
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = IMPRATIO
    option.iterations = option.ls_iterations = ITERATIONS
    option.tolerance = TOLERANCE
    return spec.compile()


@dataclass(frozen=True, eq=False)
class Record:
    """What the robot did until it fell, or until the end; a row every TIMESTEP.

    Attributes:
        qpos: As in MuJoCo, (T, 7 + J), m and rad.
        qvel: As in MuJoCo, (T, 6 + J), m/s and rad/s.
        asked: Torques that the controller asked for, (T, J), N m.
        torque: Torques that the motors gave, (T, J), N m.
        force: Normal forces on the feet, (T, F), N.
        foot_height: Of the lowest points of the feet, (T, F), m.
        control_steps: Physics steps of a control step.
        has_fallen: Whether it ended by a fall.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    asked: np.ndarray
    torque: np.ndarray
    force: np.ndarray
    foot_height: np.ndarray
    control_steps: int
    has_fallen: bool

    def counted(self, settle: float) -> Record:
        """Return the record without its first seconds."""
        first = round(settle / TIMESTEP)
        arrays = {k: v[first:] for k, v in vars(self).items() if isinstance(v, np.ndarray)}
        return replace(self, **arrays)

    @property
    def joint_pos(self) -> np.ndarray:
        """Joint angles, (T, J), rad."""
        return self.qpos[:, 7:]

    @property
    def drift(self) -> float:
        """Horizontal way from the first row to the last one, m."""
        return float(np.linalg.norm(self.qpos[-1, :2] - self.qpos[0, :2]))

    def walk(self) -> Walk:
        """Return posture and gait."""
        w, x, y, z = self.qpos[:, 3:7].T
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return Walk(
            dt=TIMESTEP,
            height=self.qpos[:, 2],
            pitch=np.arcsin(np.clip(2 * (w * y - x * z), -1.0, 1.0)),
            velocity=np.cos(yaw) * self.qvel[:, 0] + np.sin(yaw) * self.qvel[:, 1],
            contact=self.force > CONTACT_FORCE,
            foot_height=self.foot_height,
            power=np.abs(self.torque * self.qvel[:, 6:]).sum(axis=1),
        )


def run_trial(simulator: Simulator, policy: OnboardPolicy, start: Start, duration: float) -> Record:
    """Let the policy drive the robot until it falls, or for `duration` s."""
    simulator.place(start)
    policy.reset(start.joint_pos)
    control_steps = round(1.0 / (policy.metadata.control_rate * TIMESTEP))
    command, skill = (start.command, 0.0, 0.0), start.keyframe.name
    data, rows = simulator.data, []
    while not simulator.has_fallen and len(rows) < round(duration / TIMESTEP):
        if len(rows) % control_steps == 0:
            joints = data.qpos[7:], data.qvel[6:]
            target = policy.step(*joints, data.qpos[3:7], data.qvel[3:6], command, skill)
        before = data.qpos.copy(), data.qvel.copy()
        simulator.step(target)
        torques = simulator.asked, simulator.torque
        rows.append((*before, *torques, simulator.foot_force, simulator.foot_height))
    arrays = map(np.stack, zip(*rows, strict=True))
    return Record(*arrays, control_steps=control_steps, has_fallen=simulator.has_fallen)


@dataclass(frozen=True)
class Trials:
    """What is tried of a skill.

    Attributes:
        count: Trials, of walking and of standing each.
        commands: v_x of walking to draw from, m/s.
        tell: Called with the share that is done, 0 to 1.
    """

    count: int
    commands: Sequence[float]
    tell: Callable[[float], object] = lambda share: None


def try_skill(
    robot: Robot, policy: OnboardPolicy, skill: str, trials: Trials, limits: np.ndarray
) -> dict[str, dict]:
    """Return plain values of walking and of standing in one skill.

    Args:
        robot: The policy's robot.
        policy: The policy.
        skill: Name of the skill.
        trials: How many, and how fast.
        limits: Least and largest angle of each joint, (J, 2), rad.
    """
    simulator, keyframe = Simulator(robot), robot.keyframe(skill)

    def run(commands: Sequence[float], duration: float, done: float) -> list[Record]:
        records = []
        for number in range(trials.count):
            start = draw_start(keyframe, number, commands)
            records.append(run_trial(simulator, policy, start, duration))
            trials.tell(done + 0.5 * len(records) / trials.count)
        return records

    walking = run(trials.commands, DURATION, 0.0)
    standing = run((0.0,), STANDING, 0.5)
    return {
        "walk": _walking(walking, robot, keyframe, limits),
        "stand": _standing(standing, keyframe),
    }


def _walking(
    records: list[Record], robot: Robot, keyframe: Keyframe, limits: np.ndarray
) -> dict[str, object]:
    counted = [record.counted(SETTLE) for record in records]
    walks = [record.walk() for record in counted]
    seldom = [walk.thinned(records[0].control_steps) for walk in walks]
    posture = keyframe.base_height, keyframe.pitch
    return {
        **describe(walks, *posture),
        **loads(counted, robot, limits),
        "falls": _falls(records),
        "sampled": describe(seldom, *posture),
    }


def _standing(records: list[Record], keyframe: Keyframe) -> dict[str, object]:
    posture = keyframe.base_height, keyframe.pitch
    return {
        **describe([record.walk() for record in records], *posture),
        "drift": float(np.mean([record.drift for record in records])),
        "falls": _falls(records),
    }


def _falls(records: list[Record]) -> float:
    return float(np.mean([record.has_fallen for record in records]))


def loads(records: list[Record], robot: Robot, limits: np.ndarray) -> dict[str, Any]:
    """Return what walks ask of joints and motors; None where there is nothing to count.

    Args:
        records: Of several trials.
        robot: The robot.
        limits: Least and largest angle of each joint, (J, 2), rad.

    Returns:
        `beyond`: share of the control steps with a joint beyond its limits. `saturated`: share of
        the physics steps with a motor that gives less than it is asked for. `peak_torque`: largest
        |torque| by kind of joint, N m. `peak_speed`: largest |velocity| of a joint, rad/s.
    """
    records = [record for record in records if len(record.qpos)]
    if not records:
        return dict.fromkeys(("beyond", "saturated", "peak_torque", "peak_speed"))
    angles = np.concatenate([r.joint_pos[:: r.control_steps] for r in records])
    beyond = (angles < limits[:, 0]) | (angles > limits[:, 1])
    torque = np.concatenate([r.torque for r in records])
    short = np.concatenate([r.asked for r in records]) != torque
    peaks = np.abs(torque).max(axis=0)
    kinds = [joint_kind(name) for name in robot.joint_names]
    return {
        "beyond": float(beyond.any(axis=1).mean()),
        "saturated": float(short.any(axis=1).mean()),
        "peak_torque": {
            kind: float(max(p for p, k in zip(peaks, kinds, strict=True) if k == kind))
            for kind in dict.fromkeys(kinds)
        },
        "peak_speed": float(max(np.abs(r.qvel[:, 6:]).max() for r in records)),
    }


def joint_kind(name: str) -> str:
    """Return what the joints of all legs have in common: HFE of FL_HFE, calf of FR_calf_joint."""
    return name.partition("_")[2].removesuffix("_joint") or name
