"""Reading of robot files: every mistake becomes one line that says where and what is allowed."""

from __future__ import annotations

import difflib
import fnmatch
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import yaml


class RobotError(ValueError):
    """A robot's files or its name are wrong; the text says where and what is allowed."""


def hint(name: object, allowed: Iterable[str]) -> str:
    """Return `` (did you mean 'x'?)`` when an allowed name is close to ``name``, else nothing."""
    close = difflib.get_close_matches(str(name), list(allowed), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the mapping in a YAML file.

    Raises:
        RobotError: if the file is missing, is not YAML or holds no mapping.
    """
    try:
        entries = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise RobotError(f"{path} is missing") from error
    except yaml.YAMLError as error:
        raise RobotError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from error
    if not isinstance(entries, dict) or not entries:
        raise RobotError(f"{path} must hold `name: value` entries")
    return entries


def check_keys(
    entries: dict[str, Any], allowed: tuple[str, ...], required: tuple[str, ...], where: str
) -> None:
    """Refuse unknown keys, with the nearest allowed one, and missing keys.

    Raises:
        RobotError: naming the key and ``where`` it stands.
    """
    for key in entries:
        if key not in allowed:
            raise RobotError(
                f"unknown key {key!r} in {where}{hint(key, allowed)}; allowed: {', '.join(allowed)}"
            )
    missing = [key for key in required if key not in entries]
    if missing:
        raise RobotError(f"missing in {where}: {', '.join(missing)}")


def number(value: object, what: str, where: str) -> float:
    """Return a finite number.

    Raises:
        RobotError: if it is something else.
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise RobotError(f"{what} must be a number, not {value!r}, in {where}")
    return float(value)


def per_joint(key: str, value: object, joints: tuple[str, ...], where: str) -> np.ndarray:
    """Return one number a joint, shape (J,), from a number or from {name pattern: number}.

    Raises:
        RobotError: if a pattern fits no joint, or a joint has no value.
    """
    patterns = value if isinstance(value, dict) else {"*": value}
    values = np.full(len(joints), np.nan)
    for pattern, entry in patterns.items():
        matches = fnmatch.filter(joints, pattern)
        if not matches:
            raise RobotError(
                f"{key}: {pattern!r} fits no joint of {', '.join(joints)}"
                f"{hint(pattern, joints)} in {where}"
            )
        values[[joints.index(joint) for joint in matches]] = number(entry, key, where)
    missing = [joint for joint, entry in zip(joints, values, strict=True) if np.isnan(entry)]
    if missing:
        raise RobotError(f"{key} has no value for {', '.join(missing)} in {where}")
    return frozen(values)


def matching(key: str, patterns: object, names: list[str], where: str) -> tuple[str, ...]:
    """Return the names that fit any of the patterns, in the order of patterns, then of names.

    Raises:
        RobotError: if a pattern fits none of them.
    """
    if not isinstance(patterns, list) or not patterns:
        raise RobotError(f"{key} must be a list of names, not {patterns!r}, in {where}")
    found: list[str] = []
    for pattern in patterns:
        fits = fnmatch.filter(names, str(pattern))
        if not fits:
            raise RobotError(
                f"{key}: {pattern!r} is not in the MJCF{hint(pattern, names)}; "
                f"there are: {', '.join(names)} ({where})"
            )
        found.extend(name for name in fits if name not in found)
    return tuple(found)


def frozen(values: np.ndarray) -> np.ndarray:
    """Return the array, no longer writable: robots are shared between their users."""
    values.flags.writeable = False
    return values
