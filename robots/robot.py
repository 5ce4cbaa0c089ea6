"""A robot is a folder of data: MJCF, robot.yaml (gains, limits, geoms), keyframes.yaml (skills)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import mujoco
import numpy as np

from kiras_rl.robots.keyframes import Keyframe, KeyframeReader
from kiras_rl.robots.reading import (
    RobotError,
    check_keys,
    hint,
    matching,
    per_joint,
    read_yaml,
)

__all__ = ["ROBOTS", "Keyframe", "Robot", "RobotError", "list_robots", "load_robot"]

ROBOTS = Path(__file__).parent
"""The folder that holds one folder a robot."""

_VISUAL_GROUP = 2

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
    keyframes: tuple[Keyframe, ...]
    """One a skill, in the order of keyframes.yaml."""
    folder: Path = field(repr=False)
    """Where robot.yaml, keyframes.yaml and the MJCF lie."""

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
        """Return the scene with the robot and its position actuators, ready to add to and compile.

        Args:
            visuals: keep the geoms that are only looked at. Without them a physics step is
                faster and the physics is the same.
        """
        spec = _scene_spec(self.folder)
        for joint, kp, kd, limit in zip(
            self.joint_names, self.kp, self.kd, self.torque_limit, strict=True
        ):
            actuator = spec.add_actuator(
                name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT
            )
            actuator.set_to_position(kp=float(kp), kv=float(kd))
            actuator.forcerange = (-float(limit), float(limit))
        if not visuals:
            for geom in [geom for geom in spec.geoms if geom.group == _VISUAL_GROUP]:
                spec.delete(geom)
        return spec


def list_robots(root: Path = ROBOTS) -> list[str]:
    """Return the names of all robots: the folders that hold a robot.yaml."""
    return sorted(path.parent.name for path in root.glob("*/robot.yaml"))


def load_robot(name: str, root: Path = ROBOTS) -> Robot:
    """Read a robot's folder and check it against its MJCF.

    Args:
        name: one of ``list_robots(root)``.
        root: folder of robot folders.

    Raises:
        RobotError: if the robot is unknown, or one of its files is wrong.
    """
    if name not in list_robots(root):
        raise RobotError(
            f"there is no robot {name!r}{hint(name, list_robots(root))}; "
            f"available: {', '.join(list_robots(root))} (folders of {root})"
        )
    folder = root / name
    where = str(folder / "robot.yaml")
    entries = read_yaml(folder / "robot.yaml")
    check_keys(entries, _KEYS, required=_KEYS, where=where)
    model = _robot_model(folder)
    parts = _named_parts(entries, model, where)
    keyframes = _read_keyframes(folder, model, parts)
    joints = parts["joint_names"]
    return Robot(
        name=name,
        default_joint_pos=_default_pose(entries["default_joint_pos"], keyframes, joints, where),
        kp=per_joint("kp", entries["kp"], joints, where),
        kd=per_joint("kd", entries["kd"], joints, where),
        torque_limit=per_joint("torque_limit", entries["torque_limit"], joints, where),
        action_scale=per_joint("action_scale", entries["action_scale"], joints, where),
        foot_radius=_foot_radius(model, parts["foot_geoms"]),
        keyframes=keyframes,
        folder=folder,
        **parts,
    )


def _mjcf(folder: Path) -> Path:
    return folder / f"{folder.name}.xml"


def _scene_spec(folder: Path) -> mujoco.MjSpec:
    """Join scene.xml and the robot's MJCF into one document.

    Including keeps all names as they are; attaching without a prefix makes MuJoCo warn.
    """
    files = (ROBOTS / "scene.xml", _mjcf(folder))
    includes = "".join(f"<include file={quoteattr(str(file))}/>" for file in files)
    spec = mujoco.MjSpec.from_string(f"<mujoco model={quoteattr(folder.name)}>{includes}</mujoco>")
    spec.modelfiledir = str(folder)
    return spec


def _robot_model(folder: Path) -> mujoco.MjModel:
    """Compile the robot alone, which is ten times faster than with its scene."""
    if not _mjcf(folder).is_file():
        raise RobotError(f"robot {folder.name!r} has no MJCF: {_mjcf(folder)} is missing")
    try:
        return mujoco.MjModel.from_xml_path(str(_mjcf(folder)))
    except ValueError as error:
        raise RobotError(f"{_mjcf(folder)}: {' '.join(str(error).split())}") from error


def _named_parts(entries: dict[str, Any], model: mujoco.MjModel, where: str) -> dict[str, Any]:
    """Check the joints, body and geoms that robot.yaml names against the MJCF."""
    joints = [model.joint(i).name for i in range(model.njnt)][1:]  # 0 is the free joint
    if model.njnt == 0 or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
        raise RobotError(f"the first joint of the MJCF must be free ({where})")
    if entries["joints"] != joints:
        raise RobotError(
            f"joints must be in the MJCF's order [{', '.join(joints)}], "
            f"not {entries['joints']!r}, in {where}"
        )
    bodies = [model.body(i).name for i in range(1, model.nbody)]
    geoms = [name for name in (model.geom(i).name for i in range(model.ngeom)) if name]
    return {
        "joint_names": tuple(joints),
        "base_body": matching("base_body", [entries["base_body"]], bodies, where)[0],
        **{
            key: matching(key, entries[key], geoms, where)
            for key in ("base_geoms", "penalised_geoms", "foot_geoms")
        },
    }


def _read_keyframes(
    folder: Path, model: mujoco.MjModel, parts: dict[str, Any]
) -> tuple[Keyframe, ...]:
    reader = KeyframeReader(
        robot=folder.name,
        path=folder / "keyframes.yaml",
        model=model,
        foot_radius=_foot_radius(model, parts["foot_geoms"]),
        **{key: parts[key] for key in ("joint_names", "base_body", "foot_geoms")},
    )
    return reader.read()


def _foot_radius(model: mujoco.MjModel, feet: tuple[str, ...]) -> float:
    radii = {float(model.geom(foot).size[0]) for foot in feet}
    types = {int(model.geom(foot).type[0]) for foot in feet}
    if len(radii) != 1 or types != {int(mujoco.mjtGeom.mjGEOM_SPHERE)}:
        raise RobotError(f"foot_geoms {', '.join(feet)} must be spheres of one size in the MJCF")
    return radii.pop()


def _default_pose(
    entry: Any, keyframes: tuple[Keyframe, ...], joints: tuple[str, ...], where: str
) -> np.ndarray:
    """Return q0 from joint angles or from the name of a keyframe. Shape (J,), rad."""
    if not isinstance(entry, str):
        return per_joint("default_joint_pos", entry, joints, where)
    poses = {keyframe.name: keyframe.joint_pos for keyframe in keyframes}
    if entry not in poses:
        raise RobotError(
            f"default_joint_pos: there is no keyframe {entry!r}{hint(entry, poses)}; "
            f"there are: {', '.join(poses)} ({where})"
        )
    return poses[entry]
