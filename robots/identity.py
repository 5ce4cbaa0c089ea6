"""What of a robot belongs to a training, and what has changed of it since."""

from __future__ import annotations

import hashlib
from typing import Any
from xml.etree.ElementTree import canonicalize

import numpy as np

from kiras_rl.robots.robot import Robot

_PER_JOINT = (
    "default_joint_pos",
    "kp",
    "kd",
    "torque_limit",
    "action_scale",
    "joint_limits",
    "velocity_limit",
)


def identity(robot: Robot) -> dict[str, Any]:
    """Return what a training on a robot depends on, as plain values.

    Of the MJCF it is a digest, without comments and space.
    """
    values: dict[str, Any] = {"joints": list(robot.joint_names)}
    values |= {name: np.asarray(getattr(robot, name)).tolist() for name in _PER_JOINT}
    values |= {f"motor.{name}": value.tolist() for name, value in vars(robot.motor).items()}
    for frame in robot.keyframes:
        pose = [frame.base_height, frame.pitch, *np.asarray(frame.joint_pos).tolist()]
        values[f"keyframe {frame.name}"] = pose
    text = canonicalize(from_file=str(robot.mjcf), strip_text=True)
    return values | {robot.mjcf.name: hashlib.sha256(text.encode()).hexdigest()[:16]}


def change(before: dict[str, Any], now: dict[str, Any]) -> str | None:
    """Return the first change between two identities in words, or None."""
    for key, value in now.items():
        if key not in before:
            if key.startswith("keyframe "):
                return f"{key} is new"
            continue  # an earlier version did not keep it
        if before[key] != value:
            return _difference(key, before[key], value)
    gone = next((key for key in before if key.startswith("keyframe ") and key not in now), None)
    return f"{gone} is gone" if gone else None


def _difference(key: str, before: Any, now: Any) -> str:
    if not isinstance(now, list) or len(now) != len(before):
        return f"{key} is another one"
    index = next(i for i, (a, b) in enumerate(zip(before, now, strict=True)) if a != b)
    return f"{key} (number {index}) was {before[index]} and is {now[index]}"
