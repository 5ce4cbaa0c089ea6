"""What a robot's MJCF has to be (docs/extending.md): each rule finds what breaks it.

Whatever uses a robot relies on these rules, so they are checked where it is loaded.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from kiras_rl.robots.reading import RobotError
from kiras_rl.robots.scene import SCENE, compile_spec, read_mjcf

VISUAL_GROUP = 2
"""Geoms that are only looked at; training leaves them out."""

_FREE, _HINGE = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_HINGE)
_TOLERANCE = 1e-4  # m
_BEND = 0.3  # rad; the legs are compared with MuJoCo's in some pose
_NAMED = ("geoms", "lights", "textures", "materials", "bodies", "joints", "sites", "cameras")


@dataclass(frozen=True)
class _Mjcf:
    """A robot's file, read and compiled alone."""

    path: Path
    spec: mujoco.MjSpec
    model: mujoco.MjModel

    def joint(self, index: int) -> str:
        return self.model.joint(index).name or f"number {index}"

    def body(self, index: int) -> str:
        return self.model.body(index).name or f"number {index}"

    def geom(self, index: int) -> str:
        name, body = self.model.geom(index).name, self.body(int(self.model.geom_bodyid[index]))
        return f"geom {name!r}" if name else f"a geom of body {body!r}"


def load_mjcf(path: Path) -> mujoco.MjModel:
    """Compile a robot alone, which is ten times faster than with its scene, and check its rules.

    Raises:
        RobotError: if MuJoCo refuses the file, or it breaks a rule that needs no robot.yaml.
    """
    spec = read_mjcf(path)
    mjcf = _Mjcf(path, spec, compile_spec(spec, path))
    for rule in (_parts, _joints, _tree, _names, _contacts, _visuals):
        for problem in rule(mjcf):
            raise RobotError(f"{path}: {problem}")
    return mjcf.model


def check_named_parts(
    model: mujoco.MjModel, path: Path, base_body: str, feet: tuple[str, ...], named: tuple[str, ...]
) -> None:
    """Check what robot.yaml names against the rules.

    Args:
        model: the robot alone.
        path: its robot.yaml.
        base_body: name of the base.
        feet: names of the foot geoms.
        named: names of all geoms that robot.yaml names.

    Raises:
        RobotError: if the base does not float, a named geom touches nothing, feet are no spheres of
            one size, or legs differ.
    """
    base = int(model.jnt_bodyid[0])
    if model.body(base_body).id != base:
        raise RobotError(
            f"base_body: {base_body!r} does not carry the free joint; name "
            f"{model.body(base).name!r} in {path}"
        )
    for name in named:
        if not model.geom(name).conaffinity[0]:
            raise RobotError(
                f'geom {name!r} touches nothing: name one with conaffinity="1" in {path}'
            )
    radii = {float(model.geom(foot).size[0]) for foot in feet}
    types = {int(model.geom(foot).type[0]) for foot in feet}
    if len(radii) != 1 or types != {int(mujoco.mjtGeom.mjGEOM_SPHERE)}:
        raise RobotError(
            f"foot_geoms {', '.join(feet)} must be spheres of one size in the MJCF ({path})"
        )
    lengths = {foot: len(_chain(model, foot)) for foot in feet}
    if len(set(lengths.values())) > 1 or not all(lengths.values()):
        links = ", ".join(f"{foot} {length}" for foot, length in lengths.items())
        raise RobotError(
            f"foot_geoms: every leg needs the same number of hinges, one at least, not {links} "
            f"({path})"
        )
    _check_legs(model, feet, path)


def _parts(mjcf: _Mjcf) -> Iterator[str]:
    counts = {"actuator": mjcf.model.nu, "sensor": mjcf.model.nsensor}
    for name, count in counts.items():
        if count:
            yield (
                f"there are {count} {name}s, which robot.yaml and the environment add themselves: "
                f"remove <{name}>"
            )


def _joints(mjcf: _Mjcf) -> Iterator[str]:
    model = mjcf.model
    if model.njnt == 0 or model.jnt_type[0] != _FREE:
        yield "the first joint must be free: give the base <freejoint/>"
    for index in range(1, model.njnt):
        if model.jnt_type[index] != _HINGE:
            yield f"joint {mjcf.joint(index)!r} must be a hinge, as all but the first one"
        if not model.joint(index).name:
            yield f"joint {mjcf.joint(index)} has no name: give it one"


def _tree(mjcf: _Mjcf) -> Iterator[str]:
    model = mjcf.model
    base = int(model.jnt_bodyid[0])
    for index in range(1, model.nbody):
        if model.body_rootid[index] != base:
            yield f"body {mjcf.body(index)!r} must hang on {mjcf.body(base)!r}, the base"
    for index in np.flatnonzero(model.geom_bodyid == 0).tolist():
        yield f"{mjcf.geom(index)} lies in the world, whose ground is the scene's: remove it"


def _names(mjcf: _Mjcf) -> Iterator[str]:
    scene = mujoco.MjSpec.from_file(str(SCENE))
    for kind in _NAMED:
        taken = {element.name for element in getattr(scene, kind)} - {"", "world"}
        for element in getattr(mjcf.spec, kind):
            if element.name in taken:
                yield f"{kind}: the name {element.name!r} is taken by {SCENE.name}: rename it"


def _contacts(mjcf: _Mjcf) -> Iterator[str]:
    model = mjcf.model
    for index in range(model.ngeom):
        bits = int(model.geom_contype[index]), int(model.geom_conaffinity[index])
        if bits not in ((0, 0), (0, 1)):
            yield (
                f'{mjcf.geom(index)} has contype="{bits[0]}" conaffinity="{bits[1]}": it has to '
                'touch the ground alone, contype="0" conaffinity="1", or nothing, both 0'
            )
        if bits[1] and model.geom_priority[index] < 1:
            yield f'{mjcf.geom(index)} needs priority="1", so that its own friction decides'
        if bits[1] and model.geom_group[index] == VISUAL_GROUP:
            yield (
                f"{mjcf.geom(index)} is in group {VISUAL_GROUP}, which training leaves out, and "
                'touches the ground: put it in group="3"'
            )


def _visuals(mjcf: _Mjcf) -> Iterator[str]:
    """Find bodies that weigh something else without what is only looked at."""
    bare = read_mjcf(mjcf.path)
    seen = [geom for geom in bare.geoms if geom.group == VISUAL_GROUP]
    if all(geom.mass == 0 for geom in seen):
        return
    for geom in seen:
        bare.delete(geom)
    without = compile_spec(bare, mjcf.path)
    same = np.isclose(mjcf.model.body_mass, without.body_mass, rtol=1e-6)
    same &= np.isclose(mjcf.model.body_inertia, without.body_inertia, rtol=1e-6).all(axis=1)
    for index in np.flatnonzero(~same).tolist():
        yield (
            f"body {mjcf.body(index)!r} is heavier with its geoms of group {VISUAL_GROUP}, which "
            'training leaves out: give them mass="0"'
        )


def _chain(model: mujoco.MjModel, foot: str) -> list[int]:
    """Return the hinges from a foot up to the base."""
    body, joints = int(model.geom_bodyid[model.geom(foot).id]), []
    while body and body != model.jnt_bodyid[0]:
        first = int(model.body_jntadr[body])
        joints += range(first, first + int(model.body_jntnum[body])) if first >= 0 else ()
        body = int(model.body_parentid[body])
    return joints


def _check_legs(model: mujoco.MjModel, feet: tuple[str, ...], path: Path) -> None:
    """Refuse legs that are no chains of single hinges through the origins of parallel frames."""
    data = mujoco.MjData(model)
    data.qpos[:7] = (0, 0, 0, 1, 0, 0, 0)
    data.qpos[7:] = _BEND
    mujoco.mj_kinematics(model, data)
    for foot in feet:
        hinges = {int(model.jnt_bodyid[joint]) for joint in _chain(model, foot)}
        distance = np.linalg.norm(_foot(model, foot) - data.geom(foot).xpos)
        if len(hinges) < len(_chain(model, foot)) or distance > _TOLERANCE:
            mjcf = path.with_name(f"{path.parent.name}.xml")
            raise RobotError(
                f"{mjcf}: foot {foot!r} is {100 * distance:.1f} cm from where single hinges "
                "through the origins of its bodies, whose frames are parallel at angle 0, put it: "
                "leave out pos of the legs' joints and euler, quat and axisangle of their bodies"
            )


def _foot(model: mujoco.MjModel, foot: str) -> np.ndarray:
    """Return where single hinges, all at _BEND, put a foot in the base frame. Shape (3,), m."""
    place, body = model.geom(foot).pos.copy(), int(model.geom_bodyid[model.geom(foot).id])
    while body and body != model.jnt_bodyid[0]:
        if model.body_jntnum[body]:
            axis = model.jnt_axis[model.body_jntadr[body]]
            along = axis * (axis @ place)
            place = along + np.cos(_BEND) * (place - along) + np.sin(_BEND) * np.cross(axis, place)
        place = place + model.body_pos[body]
        body = int(model.body_parentid[body])
    return place
