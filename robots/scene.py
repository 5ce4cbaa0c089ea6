"""The scene with a robot's bodies in it: of the robot's file nothing else reaches the world.

World options, flags, visual settings and defaults are the scene's, whatever the robot's file says.
"""

from __future__ import annotations

import logging
from functools import cache
from pathlib import Path

import mujoco

from kiras_rl.robots.reading import RobotError

SCENE = Path(__file__).parent / "scene.xml"

_log = logging.getLogger(__name__)
_HARMLESS = "Attaching a spec with an empty prefix"  # names stay as they are; nothing is saved
_CONFLICT = "Attach conflict"
_UNUSABLE = (ValueError, RuntimeError, TypeError, mujoco.FatalError)
"""What MuJoCo raises of a file that it cannot use."""


def hear_warnings() -> None:
    """Log what MuJoCo warns of; it would print it, and write it into the current folder."""
    mujoco.set_mju_user_warning(_hear)


def _hear(text: str) -> None:
    text = " ".join(text.split())
    if text.startswith(_CONFLICT):
        _say_once(text)
    elif not text.startswith(_HARMLESS):
        _log.warning(text)


@cache
def _say_once(text: str) -> None:
    _log.info("Of a robot's file the world options are left out: %s", text)


def read_mjcf(path: Path) -> mujoco.MjSpec:
    """Return the robot alone, with the assets that its file names.

    Raises:
        RobotError: if the file is missing, or MuJoCo cannot read it.
    """
    if not path.is_file():
        raise RobotError(f"robot {path.stem!r} has no MJCF: {path} is missing")
    try:
        return mujoco.MjSpec.from_file(str(path))
    except _UNUSABLE as error:
        raise RobotError(f"{path}: {_one_line(error)}") from error


def compile_spec(spec: mujoco.MjSpec, path: Path) -> mujoco.MjModel:
    """Return the compiled model.

    Raises:
        RobotError: if MuJoCo refuses what `path` holds.
    """
    try:
        return spec.compile()
    except _UNUSABLE as error:
        raise RobotError(f"{path}: {_one_line(error)}") from error


def put_into_scene(path: Path) -> mujoco.MjSpec:
    """Return scene.xml with the robot of an MJCF in it; names stay as they are.

    Raises:
        RobotError: as `read_mjcf`.
    """
    hear_warnings()
    scene, robot = mujoco.MjSpec.from_file(str(SCENE)), read_mjcf(path)
    scene.modelname = path.stem
    scene.attach(robot, frame=scene.worldbody.add_frame(), prefix="")
    return scene.copy()  # which forgets the warnings, or compiling would repeat them


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()).removeprefix("Error: ")
