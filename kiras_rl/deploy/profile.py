"""What kiras-robot has to know of a robot beside its policy: electronics, and when to stop it.

The numbers come from the block `onboard` of a robot's robot.yaml, which says where each is from,
and travel in the policy file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

WARNS, LOWERS, DAMPS = range(3)
"""Places in `late_ticks`."""


@dataclass(frozen=True)
class Profile:
    """Numbers of one robot; those that are None belong to something that it does not measure."""

    rate: float
    """Of the driver, Hz."""
    damping: float
    """Of Mode.DAMP, N m s/rad, each joint."""
    max_kp: float
    """Largest position gain that the electronics can carry, N m/rad."""
    needs_calibration: bool
    """Whether the zeros of the joints are unknown after power-on."""
    max_age: float
    """Of a reading, control periods."""
    max_tilt: float
    """Between gravity and that of the nearest keyframe that counts, degrees."""
    range_margin: float
    """How far a joint may be beyond its range, rad: a loaded joint passes its target."""
    folded_margin: float
    """The same of a robot that lies, gets up or lies down, rad."""
    torque_factor: float
    """Of `torque_limit`: a motor that tells more does not obey it."""
    max_power: float
    """Mechanical power of all joints that push, mean over `power_time`, W."""
    power_time: float
    """s."""
    frozen_travel: float
    """Way of a target while its encoder does not change at all, rad."""
    tracking_error: float
    """Between a slow target and its joint, rad."""
    free_fall: float
    """Specific force below which the robot falls, m/s^2; at rest it is 9.81."""
    imu_error: float
    """Between the IMU's orientation and its accelerometer at rest, degrees."""
    max_temperature: float | None
    """Of a motor, degrees Celsius."""
    min_battery: float | None
    """Share of the charge, 0 to 1."""
    late_ticks: tuple[int, int, int]
    """Late ticks in a row that warn, lower the robot, and damp it."""
    slew: float
    """Change of a target in a control period, of the policy file's `action_scale`."""
    takeover_joint: float
    """Between joint and posture where the policy takes over, rad."""
    takeover_tilt: float
    """Between gravity and that of the posture there, degrees."""
    takeover_target: float
    """Between the policy's first targets and those that are held, rad."""

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Profile:
        """Build from plain data; keys of later versions are left out.

        Raises:
            KeyError: If one is missing.
            TypeError: If a value is of another kind.
            ValueError: If a number is not finite, negative, or 0 where that makes no sense.
        """
        values = {field.name: data[field.name] for field in fields(cls)}
        numbers: dict[str, Any] = {
            name: None if value is None and name in _NOT_MEASURED else _number(name, value)
            for name, value in values.items()
            if name not in ("needs_calibration", "late_ticks")
        }
        warns, lowers, damps = (int(_number("late_ticks", tick)) for tick in values["late_ticks"])
        calibrates = bool(values["needs_calibration"])
        return cls(**numbers, needs_calibration=calibrates, late_ticks=(warns, lowers, damps))


_NOT_MEASURED = ("max_temperature", "min_battery")
_MAY_BE_ZERO = ("range_margin", "folded_margin", "free_fall", "min_battery")


def _number(name: str, value: Any) -> float:
    number = float(value)
    if not math.isfinite(number) or number < 0 or (number == 0 and name not in _MAY_BE_ZERO):
        raise ValueError(f"{name} is {value}")
    return number
