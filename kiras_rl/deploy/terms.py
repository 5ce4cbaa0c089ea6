"""Observation terms on the robot: each rebuilds from a reading what one of the training observed.

A term of the training names its twin, `@observed(unit="rad", onboard=pitch)`. The policy file names
each twin: one of this module by its name alone, one of the user's as package.module:function. The
file that holds it is imported on the robot, where there may be no torch.
"""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, TypeVar

import numpy as np

F = TypeVar("F", bound=Callable)


@dataclass(frozen=True)
class Reading:
    """What one frame is built from, checked; J joints, S skills.

    Attributes:
        joint_pos: Relative to the default pose, (J,), rad.
        joint_vel: (J,), rad/s.
        imu_quat: Orientation of the base in the world, (4,), w x y z; only its tilt counts.
        base_ang_vel: In the base frame, (3,), rad/s.
        command: Forward and sideward velocity in m/s and yaw rate in rad/s, (3,).
        skill: One-hot code of the skill, (S,).
        last_action: Clipped, (J,).
        time: Since the policy began, s.
    """

    joint_pos: np.ndarray
    joint_vel: np.ndarray
    imu_quat: np.ndarray
    base_ang_vel: np.ndarray
    command: np.ndarray
    skill: np.ndarray
    last_action: np.ndarray
    time: float = 0.0

    @classmethod
    def example(cls, joints: int, skills: int) -> Reading:
        """Return that of an upright robot at rest in its default pose."""
        rest, upright = np.zeros(joints), np.array([1.0, 0.0, 0.0, 0.0])
        zero, skill = np.zeros(3), np.eye(skills)[0]
        return cls(rest, rest, upright, zero, zero, skill, rest)


if TYPE_CHECKING:  # a robot's Python may be older than such aliases
    Rebuild = Callable[[Reading], np.ndarray]
    """A reading -> (k,), before the term's scale."""


def observed(unit: str = "", onboard: Rebuild | None = None) -> Callable[[F], F]:
    """Mark a term of an observation with its unit and its twin on the robot.

    Args:
        unit: Before the scale; empty for none.
        onboard: Rebuilds the term on a robot; None where its sensors cannot.
    """

    def mark(term: F) -> F:
        term.unit = unit  # pyright: ignore[reportFunctionMemberAccess]
        term.onboard = onboard  # pyright: ignore[reportFunctionMemberAccess]
        return term

    return mark


def path_of(rebuild: Rebuild) -> str:
    """Return the name under which `find_rebuild` finds a twin."""
    local = rebuild.__module__ == __name__
    return rebuild.__name__ if local else f"{rebuild.__module__}:{rebuild.__name__}"


def find_rebuild(path: str) -> Rebuild:
    """Return a twin by its name in a policy file.

    Raises:
        LookupError: There is none; the message says which there are, or what cannot be imported.
    """
    file, _, name = path.rpartition(":")
    try:
        twins = _twins(importlib.import_module(file or __name__))
    except ImportError as error:
        raise LookupError(f"{path} cannot be imported here ({error})") from None
    if name not in twins:
        known = ", ".join(_twins(sys.modules[__name__]))
        raise LookupError(f"known: {known}; one of your own says what rebuilds it: onboard")
    return twins[name]


def _twins(module: ModuleType) -> dict[str, Rebuild]:
    """Return the functions of a module whose only argument is `reading`, by name."""
    functions = inspect.getmembers(module, inspect.isfunction)
    return {
        name: f for name, f in functions if list(inspect.signature(f).parameters) == ["reading"]
    }


def projected_gravity(reading: Reading) -> np.ndarray:
    """Return the unit vector of gravity in the base frame, 3."""
    return gravity(reading.imu_quat)


def pitch(reading: Reading) -> np.ndarray:
    """Return the pitch, nose down positive, 1, rad."""
    w, x, y, z = reading.imu_quat
    return np.arcsin(np.clip([2 * (w * y - x * z)], -1.0, 1.0))


def base_ang_vel(reading: Reading) -> np.ndarray:
    """Return the angular velocity in the base frame, 3, rad/s."""
    return reading.base_ang_vel


def command_lin_vel_x(reading: Reading) -> np.ndarray:
    """Return the commanded forward velocity, 1, m/s."""
    return reading.command[0:1]


def command_lin_vel_y(reading: Reading) -> np.ndarray:
    """Return the commanded lateral velocity, 1, m/s."""
    return reading.command[1:2]


def command_ang_vel_z(reading: Reading) -> np.ndarray:
    """Return the commanded yaw rate, 1, rad/s."""
    return reading.command[2:3]


def skill(reading: Reading) -> np.ndarray:
    """Return the one-hot code of the skill, S."""
    return reading.skill


def joint_pos(reading: Reading) -> np.ndarray:
    """Return joint angles relative to the default pose, J, rad."""
    return reading.joint_pos


def joint_vel(reading: Reading) -> np.ndarray:
    """Return joint velocities, J, rad/s."""
    return reading.joint_vel


def last_action(reading: Reading) -> np.ndarray:
    """Return the clipped action of the last step, J."""
    return reading.last_action


def gravity(quat: np.ndarray) -> np.ndarray:
    """Return the unit vector of gravity in the base frame, (3,): minus the rotation's third row."""
    w, x, y, z = quat
    return -np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
