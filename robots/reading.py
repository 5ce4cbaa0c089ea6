"""Reading of robot files: every mistake becomes one line that says where and what is allowed."""

from __future__ import annotations

import difflib
import fnmatch
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from kiras_rl.deploy.errors import PlainError
from kiras_rl.yaml_files import YamlError, read_yaml_file

RANGES = {
    "kp": (0.0, np.inf, True),
    "kd": (0.0, np.inf, False),
    "torque_limit": (0.0, np.inf, True),
    "velocity_limit": (0.0, np.inf, True),
    "stall_torque": (0.0, np.inf, True),
    "no_load_speed": (0.0, np.inf, True),
    "action_scale": (0.0, np.inf, True),
    "base_height": (0.0, np.inf, True),
    "pitch": (-89.0, 89.0, False),
    "onboard.rate": (1.0, 10_000.0, False),
    "onboard.damping": (0.0, np.inf, True),
    "onboard.max_kp": (0.0, np.inf, True),
    "onboard.max_age": (1.0, 50.0, False),
    "onboard.max_tilt": (0.0, 180.0, True),
    "onboard.range_margin": (0.0, 3.2, False),
    "onboard.folded_margin": (0.0, 3.2, False),
    "onboard.torque_factor": (1.0, 10.0, False),
    "onboard.max_power": (0.0, np.inf, True),
    "onboard.power_time": (0.0, 60.0, True),
    "onboard.frozen_travel": (0.0, 3.2, True),
    "onboard.tracking_error": (0.0, 3.2, True),
    "onboard.free_fall": (0.0, 9.8, False),
    "onboard.imu_error": (0.0, 180.0, True),
    "onboard.max_temperature": (0.0, 200.0, True),
    "onboard.min_battery": (0.0, 1.0, False),
    "onboard.slew": (0.0, 100.0, True),
    "onboard.takeover_joint": (0.0, 3.2, True),
    "onboard.takeover_tilt": (0.0, 180.0, True),
    "onboard.takeover_target": (0.0, 3.2, True),
}
"""Of a key's numbers: least, largest, and whether the least itself is too little."""


class RobotError(PlainError, ValueError):
    """A robot's files or its name are wrong; the text says where and what is allowed."""


def hint(name: object, allowed: Iterable[str]) -> str:
    """Return `` (did you mean 'x'?)`` when an allowed name is close to ``name``, else nothing."""
    close = difflib.get_close_matches(str(name), list(allowed), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the mapping in a YAML file, read as configurations are.

    Raises:
        RobotError: if the file is missing, is not YAML or holds no mapping.
    """
    try:
        entries = read_yaml_file(path)
    except FileNotFoundError as error:
        raise RobotError(f"{path} is missing") from error
    except OSError as error:
        raise RobotError(f"{path} cannot be read: {error.strerror}") from error
    except YamlError as error:
        raise RobotError(f"{path} is not valid YAML: {error}") from error
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
    """Return a finite number, within the range of RANGES where `what` has one.

    Raises:
        RobotError: if it is something else.
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise RobotError(f"{what} must be a number, not {value!r}, in {where}")
    low, high, open_below = RANGES.get(what, (-np.inf, np.inf, False))
    if not low <= value <= high or (open_below and value == low):
        raise RobotError(
            f"{what} must be {_range(low, high, open_below)}, not {value!r}, in {where}"
        )
    return float(value)


def _range(low: float, high: float, open_below: bool) -> str:
    if high < np.inf:
        return f"between {low:g} and {high:g}"
    return f"above {low:g}" if open_below else f"at least {low:g}"


def check_name(name: str, what: str, where: str) -> None:
    """Refuse a name that commands, tables, logs and files cannot carry.

    Raises:
        RobotError: naming what is allowed.
    """
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_.-]*", name):
        raise RobotError(
            f"{what} {name!r}: a name has letters, digits, _ . and -, and begins with a "
            f"letter or _ ({where})"
        )


def per_name(key: str, value: object, names: tuple[str, ...], where: str) -> np.ndarray:
    """Return one number per name, shape (len(names),), from a number or {name pattern: number}.

    Raises:
        RobotError: if a pattern fits none of the names, or a name has no value.
    """
    return _spread(key, value, names, where, lambda entry: [number(entry, key, where)])[:, 0]


def ranges_per_name(key: str, value: object, names: tuple[str, ...], where: str) -> np.ndarray:
    """Return [low, high] per name, shape (len(names), 2), from a pair or {name pattern: pair}.

    Raises:
        RobotError: as `per_name`, and where low is not below high.
    """

    def pair(entry: object) -> list[float]:
        if not isinstance(entry, list) or len(entry) != 2:
            raise RobotError(f"{key} must be [lowest, highest], not {entry!r}, in {where}")
        low, high = (number(x, key, where) for x in entry)
        if low >= high:
            raise RobotError(f"{key}: the first of {entry} must be the lower one, in {where}")
        return [low, high]

    return _spread(key, value, names, where, pair)


def _spread(
    key: str,
    value: object,
    names: tuple[str, ...],
    where: str,
    read: Callable[[object], list[float]],
) -> np.ndarray:
    """Give every name the numbers of the last pattern that fits it, (len(names), numbers)."""
    patterns = value if isinstance(value, dict) else {"*": value}
    found: dict[str, list[float]] = {}
    for pattern, entry in patterns.items():
        matches = fnmatch.filter(names, str(pattern))
        if not matches:
            raise RobotError(
                f"{key}: {pattern!r} fits none of {', '.join(names)}{hint(pattern, names)} "
                f"in {where}"
            )
        found |= dict.fromkeys(matches, read(entry))
    missing = [name for name in names if name not in found]
    if missing:
        raise RobotError(f"{key} has no value for {', '.join(missing)} in {where}")
    return frozen(np.array([found[name] for name in names]))


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
