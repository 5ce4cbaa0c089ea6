"""The block `onboard` of robot.yaml: what kiras-robot needs, and when it stops the robot.

`kiras_rl.deploy.profile.Profile` says what each number means; the policy file carries them there.
"""

from __future__ import annotations

from typing import Any

from kiras_rl.robots.reading import RobotError, check_keys, number

NUMBERS = (
    *("rate", "damping", "max_kp", "max_age", "max_tilt", "range_margin", "folded_margin"),
    *("torque_factor", "max_power", "power_time", "frozen_travel", "tracking_error", "free_fall"),
    *("imu_error", "slew", "takeover_joint", "takeover_tilt", "takeover_target"),
)
MEASURED = ("max_temperature", "min_battery")
"""Numbers that are null for a robot that does not measure them."""
KEYS = (*NUMBERS, *MEASURED, "needs_calibration", "late_ticks")


def read_onboard(entry: Any, where: str) -> dict[str, Any] | None:
    """Check the block, and return it as plain values; None if there is none.

    Args:
        entry: What robot.yaml holds.
        where: The file.

    Raises:
        RobotError: If a key is missing or unknown, or a value is outside of its range.
    """
    if entry is None:
        return None
    if not isinstance(entry, dict):
        raise RobotError(f"onboard must hold `name: value` entries, not {entry!r}, in {where}")
    check_keys(entry, KEYS, required=KEYS, where=f"onboard of {where}")
    values: dict[str, Any] = {
        key: number(entry[key], f"onboard.{key}", where)
        for key in (*NUMBERS, *MEASURED)
        if key in NUMBERS or entry[key] is not None
    }
    values |= {key: None for key in MEASURED if key not in values}
    calibrates = entry["needs_calibration"]
    if not isinstance(calibrates, bool):
        raise RobotError(
            f"onboard.needs_calibration must be true or false, not {calibrates!r}, in {where}"
        )
    return values | {
        "needs_calibration": calibrates,
        "late_ticks": _late_ticks(entry["late_ticks"], where),
    }


def _late_ticks(entry: Any, where: str) -> list[int]:
    whole = isinstance(entry, list) and all(type(tick) is int for tick in entry)
    if not whole or len(entry) != 3 or not 0 < entry[0] <= entry[1] <= entry[2]:
        raise RobotError(
            "onboard.late_ticks must be three whole numbers above 0 that do not fall, "
            f"not {entry!r}, in {where}"
        )
    return entry
