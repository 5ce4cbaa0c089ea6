"""A robot is a folder of data: MJCF, robot.yaml (gains, limits, geoms), keyframes.yaml (skills)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from kiras_rl.robots.keyframes import Keyframe, KeyframeReader
from kiras_rl.robots.onboard import read_onboard
from kiras_rl.robots.reading import (
    RobotError,
    check_keys,
    check_name,
    frozen,
    hint,
    matching,
    number,
    per_name,
    ranges_per_name,
    read_yaml,
)
from kiras_rl.robots.rules import VISUAL_GROUP, check_named_parts, load_mjcf
from kiras_rl.robots.scene import put_into_scene

__all__ = ["ROBOTS", "Keyframe", "Robot", "RobotError", "list_robots", "load_robot"]

ROBOTS = Path(__file__).parent
"""The folder that holds one folder a robot."""

_POSITION = int(mujoco.mjtCtrlInput.mjINPUT_POS)

_KEYS = (
    "joints",
    "base_body",
    "base_geoms",
    "penalised_geoms",
    "foot_geoms",
    "default_joint_pos",
    "action_scale",
    "kp",
    "kd",
    "torque_limit",
)
_OPTIONAL_KEYS = ("joint_limits", "velocity_limit", "motor", "clearance", "onboard", "variants")
_MOTOR_KEYS = ("stall_torque", "no_load_speed")
_CLEARANCE_SHARE = 1 / 3  # of the base height: more than that no step has to clear
_USUAL_CLEARANCE = 0.3  # of the first keyframe's base height, where robot.yaml gives none
_VARIANT = ":"  # between the names of a robot and of one of its variants


@dataclass(frozen=True, eq=False)
class Motor:
    """The torque-speed line of each joint's motor: what its supply voltage leaves for torque.

    At speed w in the direction of the torque a motor gives at most
    ``stall_torque * (1 - w / no_load_speed)``; both are infinite for a motor without a line.
    """

    stall_torque: np.ndarray
    """Torque at standstill if only the winding limited the current. Shape (J,), N m."""
    no_load_speed: np.ndarray
    """Speed at which no torque is left. Shape (J,), rad/s."""

    def largest_torque(self, velocity: np.ndarray) -> np.ndarray:
        """Return the largest torque along positive angles at joint velocities (J,), (J,), N m."""
        return self.stall_torque * (1.0 - velocity / self.no_load_speed)


@dataclass(frozen=True, eq=False)
class Robot:
    """All that the environment needs to know of a robot; arrays follow ``joint_names``."""

    name: str
    joint_names: tuple[str, ...]
    """The MJCF's order, which is also that of qpos, actuators and actions."""
    default_joint_pos: np.ndarray
    """Joint target for action 0. Shape (J,), rad."""
    kp: np.ndarray
    """Position gain. Shape (J,), N m/rad."""
    kd: np.ndarray
    """Velocity gain. Shape (J,), N m s/rad."""
    torque_limit: np.ndarray
    """Largest absolute joint torque. Shape (J,), N m."""
    joint_limits: np.ndarray
    """Least and largest angle that robot and driver allow. Shape (J, 2), rad; infinite for none."""
    velocity_limit: np.ndarray
    """Largest absolute velocity that the driver allows. Shape (J,), rad/s; infinite for none."""
    motor: Motor
    action_scale: np.ndarray
    """Change of the joint target for an action of 1. Shape (J,), rad."""
    base_body: str
    base_geoms: tuple[str, ...]
    """Collision geoms that must not touch the ground: a contact ends the episode."""
    penalised_geoms: tuple[str, ...]
    """Collision geoms of thighs and shanks: a contact costs reward."""
    foot_geoms: tuple[str, ...]
    foot_radius: float
    """Radius of the spherical feet in m."""
    step_height: float
    """Height that feet should clear in a step in m; less where the base is low."""
    keyframes: tuple[Keyframe, ...]
    """One a skill, in the order of keyframes.yaml."""
    onboard: dict[str, Any] | None
    """What kiras-robot needs, as in `kiras_rl.robots.onboard`; None if robot.yaml does not say."""
    folder: Path = field(repr=False)
    """Where robot.yaml, keyframes.yaml and the MJCF lie."""

    @property
    def clearance(self) -> np.ndarray:
        """Height that feet should clear in a step of each skill. Shape (S,), m."""
        lowest = [_CLEARANCE_SHARE * keyframe.base_height for keyframe in self.keyframes]
        return np.minimum(self.step_height, lowest)

    @property
    def mjcf(self) -> Path:
        """The file of bodies, joints and geoms."""
        return _mjcf(self.folder)

    @property
    def skills(self) -> tuple[str, ...]:
        """Names of the keyframes."""
        return tuple(keyframe.name for keyframe in self.keyframes)

    def keyframe(self, name: str) -> Keyframe:
        """Return the keyframe of a skill.

        Raises:
            RobotError: if there is none of this name.
        """
        for keyframe in self.keyframes:
            if keyframe.name == name:
                return keyframe
        raise RobotError(
            f"{self.name} has no keyframe {name!r}{hint(name, self.skills)}; "
            f"it has: {', '.join(self.skills)} ({self.folder / 'keyframes.yaml'})"
        )

    def spec(self, visuals: bool = True) -> mujoco.MjSpec:
        """Return the scene with the robot and its actuators, ready to add to and compile.

        An actuator is MuJoCo's DC motor behind a position controller: kp (target - q) - kd dq,
        within what the voltage of its supply and `torque_limit` allow.

        Args:
            visuals: keep the geoms that are only looked at. Without them a physics step is
                faster and the physics is the same.
        """
        spec = put_into_scene(self.mjcf)
        for j, joint in enumerate(self.joint_names):
            actuator = spec.add_actuator(
                name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT
            )
            _set_motor(actuator, self, j)
            limit = float(self.torque_limit[j])
            actuator.forcerange = (-limit, limit)
        if not visuals:
            for geom in [geom for geom in spec.geoms if geom.group == VISUAL_GROUP]:
                spec.delete(geom)
        return spec


def list_robots(root: Path = ROBOTS) -> list[str]:
    """Return the names of all robots: the folders that hold a robot.yaml.

    A variant of a robot (``variants`` of its robot.yaml) is named ``<robot>:<variant>``.
    """
    return sorted(path.parent.name for path in root.glob("*/robot.yaml"))


def load_robot(name: str, root: Path = ROBOTS) -> Robot:
    """Read a robot's folder and check it against its MJCF.

    Args:
        name: one of ``list_robots(root)``, or one with ``:<variant>`` behind it.
        root: folder of robot folders.

    Raises:
        RobotError: if the robot is unknown, or one of its files is wrong.
    """
    base, _, variant = str(name).partition(_VARIANT)
    if base not in list_robots(root):
        raise RobotError(
            f"there is no robot {base!r}{hint(base, list_robots(root))}; "
            f"available: {', '.join(list_robots(root))} (folders of {root})"
        )
    folder = root / base
    where = str(folder / "robot.yaml")
    check_name(base, "robot", str(folder))
    entries = _with_variant(read_yaml(folder / "robot.yaml"), name, variant, where)
    check_keys(entries, _KEYS + _OPTIONAL_KEYS, required=_KEYS, where=where)
    model = load_mjcf(_mjcf(folder))
    parts = _named_parts(entries, model, where)
    joints = parts["joint_names"]
    joint_limits = _joint_limits(entries.get("joint_limits"), model, joints, where)
    keyframes = _read_keyframes(folder, model, parts, joint_limits)
    return Robot(
        name=name,
        default_joint_pos=_default_pose(entries["default_joint_pos"], keyframes, joints, where),
        **{
            key: per_name(key, entries[key], joints, where)
            for key in ("kp", "kd", "torque_limit", "action_scale")
        },
        joint_limits=joint_limits,
        step_height=number(
            entries.get("clearance", _USUAL_CLEARANCE * keyframes[0].base_height),
            "clearance",
            where,
        ),
        velocity_limit=_optional("velocity_limit", entries, joints, where),
        motor=_motor(entries.get("motor"), joints, where),
        foot_radius=_foot_radius(model, parts["foot_geoms"]),
        keyframes=keyframes,
        onboard=read_onboard(entries.get("onboard"), where),
        folder=folder,
        **parts,
    )


def _with_variant(entries: dict[str, Any], name: str, variant: str, where: str) -> dict[str, Any]:
    """Return the entries with those of a variant in their place."""
    variants = entries.pop("variants", {})
    if not isinstance(variants, dict) or not all(isinstance(v, dict) for v in variants.values()):
        raise RobotError(f"variants must hold `name: {{key: value}}` entries in {where}")
    if _VARIANT not in name:
        return entries
    if variant not in variants:
        raise RobotError(
            f"there is no robot {name!r}{hint(variant, variants)}; "
            f"variants: {', '.join(variants) or 'none'} ({where})"
        )
    return entries | variants[variant]


def _joint_limits(
    entry: Any, model: mujoco.MjModel, joints: tuple[str, ...], where: str
) -> np.ndarray:
    """Return what both the MJCF and robot.yaml allow. Shape (J, 2), rad."""
    ids = [model.joint(joint).id for joint in joints]
    limited = model.jnt_limited[ids, None].astype(bool)
    limits = np.where(limited, model.jnt_range[ids], (-np.inf, np.inf))
    if entry is not None:
        given = ranges_per_name("joint_limits", entry, joints, where)
        limits = np.stack(
            [np.maximum(limits[:, 0], given[:, 0]), np.minimum(limits[:, 1], given[:, 1])], axis=1
        )
    return frozen(limits)


def _optional(key: str, entries: dict[str, Any], joints: tuple[str, ...], where: str) -> np.ndarray:
    """Return a number per joint, infinite where the file gives none. Shape (J,)."""
    if key not in entries:
        return frozen(np.full(len(joints), np.inf))
    return per_name(key, entries[key], joints, where)


def _motor(entry: Any, joints: tuple[str, ...], where: str) -> Motor:
    if entry is None:
        entry = {}
    elif not isinstance(entry, dict):
        raise RobotError(f"motor must hold {', '.join(_MOTOR_KEYS)}, not {entry!r}, in {where}")
    else:
        check_keys(entry, _MOTOR_KEYS, required=_MOTOR_KEYS, where=f"motor of {where}")
    return Motor(**{key: _optional(key, entry, joints, where) for key in _MOTOR_KEYS})


def _set_motor(actuator: Any, robot: Robot, joint: int) -> None:
    """Make an actuator a DC motor behind a position controller.

    Only the ratios of voltage, motor constant and resistance matter for the line of a motor, so
    that the voltage is 1 V.
    """
    stall, speed = robot.motor.stall_torque[joint], robot.motor.no_load_speed[joint]
    has_line = np.isfinite(stall) and np.isfinite(speed)
    voltage = 1.0 if has_line else 0.0  # 0: no limit
    constant = 1.0 / float(speed) if has_line else 1.0
    resistance = constant / float(stall) if has_line else 1.0
    gains = float(robot.kp[joint]), float(robot.kd[joint])
    actuator.set_to_dcmotor(
        motorconst=(constant, constant),
        resistance=resistance,
        controller=(gains[0], 0.0, gains[1], 0.0, 0.0, voltage),
        ctrlspec=_POSITION,
    )


def _mjcf(folder: Path) -> Path:
    return folder / f"{folder.name}.xml"


def _named_parts(entries: dict[str, Any], model: mujoco.MjModel, where: str) -> dict[str, Any]:
    """Check the joints, body and geoms that robot.yaml names against the MJCF."""
    joints = [model.joint(i).name for i in range(model.njnt)][1:]  # 0 is the free joint
    if entries["joints"] != joints:
        raise RobotError(
            f"joints must be in the MJCF's order [{', '.join(joints)}], "
            f"not {entries['joints']!r}, in {where}"
        )
    bodies = [model.body(i).name for i in range(1, model.nbody)]
    geoms = [name for name in (model.geom(i).name for i in range(model.ngeom)) if name]
    base = matching("base_body", [entries["base_body"]], bodies, where)[0]
    named = {
        key: matching(key, entries[key], geoms, where)
        for key in ("base_geoms", "penalised_geoms", "foot_geoms")
    }
    check_named_parts(model, Path(where), base, named["foot_geoms"], sum(named.values(), ()))
    return {"joint_names": tuple(joints), "base_body": base, **named}


def _read_keyframes(
    folder: Path, model: mujoco.MjModel, parts: dict[str, Any], joint_limits: np.ndarray
) -> tuple[Keyframe, ...]:
    reader = KeyframeReader(
        robot=folder.name,
        path=folder / "keyframes.yaml",
        model=model,
        joint_limits=joint_limits,
        foot_radius=_foot_radius(model, parts["foot_geoms"]),
        **{key: parts[key] for key in ("joint_names", "base_body", "foot_geoms")},
    )
    return reader.read()


def _foot_radius(model: mujoco.MjModel, feet: tuple[str, ...]) -> float:
    return float(model.geom(feet[0]).size[0])


def _default_pose(
    entry: Any, keyframes: tuple[Keyframe, ...], joints: tuple[str, ...], where: str
) -> np.ndarray:
    """Return q0 from joint angles or from the name of a keyframe. Shape (J,), rad."""
    if not isinstance(entry, str):
        return per_name("default_joint_pos", entry, joints, where)
    poses = {keyframe.name: keyframe.joint_pos for keyframe in keyframes}
    if entry not in poses:
        raise RobotError(
            f"default_joint_pos: there is no keyframe {entry!r}{hint(entry, poses)}; "
            f"there are: {', '.join(poses)} ({where})"
        )
    return poses[entry]
