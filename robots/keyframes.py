"""Keyframes: the pose of each skill, read from keyframes.yaml and checked for reach and limits."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from kiras_rl.robots.kinematics import KNEES, Leg, LegError, ReachError, find_legs, leg_length
from kiras_rl.robots.reading import (
    RobotError,
    check_keys,
    check_name,
    frozen,
    hint,
    number,
    per_name,
    read_yaml,
)

_KEYS = ("base_height", "pitch", "knees", "feet_ahead", "joint_pos")

_LIMIT_SLACK = 1e-3
"""rad; angles written with three decimals may sit on a limit."""


@dataclass(frozen=True, eq=False)
class Keyframe:
    """The target pose of one skill."""

    name: str
    base_height: float
    """Height of the base frame above the ground in m."""
    pitch: float
    """Pitch of the base in rad; positive is nose down."""
    joint_pos: np.ndarray
    """Joint angles. Shape (J,), rad."""

    @property
    def quat(self) -> np.ndarray:
        """Orientation of the base (w, x, y, z). Shape (4,)."""
        return np.array([np.cos(self.pitch / 2), 0.0, np.sin(self.pitch / 2), 0.0])

    @property
    def qpos(self) -> np.ndarray:
        """Base position, orientation and joints as in MuJoCo. Shape (7 + J,), m and rad."""
        return np.concatenate(([0.0, 0.0, self.base_height], self.quat, self.joint_pos))


@dataclass(frozen=True, eq=False)
class KeyframeReader:
    """Reads the keyframes of one robot."""

    robot: str
    path: Path
    """The keyframes.yaml."""
    model: mujoco.MjModel
    """The robot's MJCF, compiled."""
    joint_names: tuple[str, ...]
    base_body: str
    foot_geoms: tuple[str, ...]
    foot_radius: float
    joint_limits: np.ndarray
    """Lowest and highest angle of each joint. Shape (J, 2), rad."""

    @functools.cached_property
    def legs(self) -> tuple[Leg, ...]:
        """The legs that inverse kinematics works on."""
        return find_legs(self.model, self.base_body, self.foot_geoms)

    def read(self) -> tuple[Keyframe, ...]:
        """Return all keyframes in the order of the file.

        Raises:
            RobotError: at the first entry that is wrong or that the robot cannot take.
        """
        return tuple(self._keyframe(name, entry) for name, entry in read_yaml(self.path).items())

    def _keyframe(self, name: str, entry: Any) -> Keyframe:
        where = f"keyframe {name!r} of {self.robot} ({self.path})"
        check_name(name, "keyframe", str(self.path))
        if not isinstance(entry, dict):
            raise RobotError(f"{where} must hold {', '.join(_KEYS)}, not {entry!r}")
        check_keys(entry, _KEYS, required=("base_height", "pitch"), where=where)
        if ("knees" in entry) == ("joint_pos" in entry):
            raise RobotError(f"{where} needs either knees or joint_pos")
        height = number(entry["base_height"], "base_height", where)
        pitch = np.deg2rad(number(entry["pitch"], "pitch", where))
        if "knees" in entry:
            ahead = per_name("feet_ahead", entry.get("feet_ahead", 0.0), self.foot_geoms, where)
            joint_pos = self._solve(name, height, pitch, entry["knees"], ahead, where)
        else:
            if "feet_ahead" in entry:
                raise RobotError(f"feet_ahead goes with knees, not with joint_pos, in {where}")
            joint_pos = self._given(entry["joint_pos"], where)
        self._check_limits(name, joint_pos)
        return Keyframe(str(name), height, float(pitch), frozen(joint_pos))

    def _given(self, joint_pos: Any, where: str) -> np.ndarray:
        if not isinstance(joint_pos, list) or len(joint_pos) != len(self.joint_names):
            raise RobotError(
                f"joint_pos must be a list of {len(self.joint_names)} angles in rad "
                f"({', '.join(self.joint_names)}), not {joint_pos!r}, in {where}"
            )
        return np.array([number(angle, "joint_pos", where) for angle in joint_pos])

    def _solve(
        self, name: str, height: float, pitch: float, knees: Any, ahead: np.ndarray, where: str
    ) -> np.ndarray:
        """Return the joint angles with every foot `ahead` of its hip, (F,) m. Shape (J,), rad."""
        if knees not in KNEES:
            raise RobotError(
                f"knees must be one of {', '.join(KNEES)}, not {knees!r}{hint(knees, KNEES)}, "
                f"in {where}"
            )
        joint_pos = np.zeros(len(self.joint_names))  # abduction joints, where there are, stay at 0
        try:
            for leg, distance in zip(self.legs, ahead, strict=True):
                back = knees == "back" or (knees == "inward" and leg.hip[0] > 0)
                below = leg.hip_height(height, pitch) - self.foot_radius
                angles = leg.reach_foot(below, float(distance), pitch, back)
                joint_pos[[leg.hip_joint, leg.knee_joint]] = angles
        except LegError as error:
            raise RobotError(f"{error}, in {where}") from error
        except ReachError as error:
            raise RobotError(self._unreachable(name, pitch, height, ahead)) from error
        return joint_pos

    def _unreachable(self, name: str, pitch: float, height: float, ahead: np.ndarray) -> str:
        """Describe the leg that is furthest outside its reach, and by how much."""
        lengths = [
            leg_length(leg.hip_height(height, pitch) - self.foot_radius, float(distance))
            for leg, distance in zip(self.legs, ahead, strict=True)
        ]
        over, low = max(
            max((length - leg.reach[1], False), (leg.reach[0] - length, True))
            for length, leg in zip(lengths, self.legs, strict=True)
        )
        reach = self.legs[0].reach[0 if low else 1]
        needed = reach - over if low else reach + over
        bound, verb = ("at least", "raise") if low else ("at most", "lower")
        return (
            f"keyframe {name!r} of {self.robot}: leg length {needed:.3f} m needed, "
            f"{reach:.3f} m {bound}: {verb} base_height by {over:.3f} m in {self.path}"
        )

    def _check_limits(self, name: str, joint_pos: np.ndarray) -> None:
        low, high = self.joint_limits.T
        over = np.maximum(low - joint_pos, joint_pos - high)
        worst = int(np.argmax(over))
        if over[worst] > _LIMIT_SLACK:
            raise RobotError(
                f"keyframe {name!r} of {self.robot}: {self.joint_names[worst]} at "
                f"{joint_pos[worst]:.3f} rad is {over[worst]:.3f} rad outside its limits "
                f"({low[worst]:.3f} to {high[worst]:.3f}): change base_height, pitch or feet_ahead "
                f"in {self.path}"
            )
