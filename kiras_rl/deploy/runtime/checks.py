"""What the runtime checks in every tick; each check has a name, a number and a consequence.

Numbers are those of the policy file: its limits, and its profile of the robot.

Letters: J joints.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from kiras_rl.deploy.metadata import PolicyMetadata
from kiras_rl.deploy.policy import LARGEST_READING, projected_gravity
from kiras_rl.deploy.profile import DAMPS, LOWERS, WARNS, Profile
from kiras_rl.deploy.runtime.messages import NANO, Flag, State


class Severity(IntEnum):
    """What follows."""

    WARN = 0
    """A line in the log."""
    LOWER = 1
    """The robot lies down."""
    DAMP = 2
    """The motors are damped at once."""


@dataclass(frozen=True)
class Finding:
    """What a check found."""

    name: str
    severity: Severity
    text: str
    """What was measured, and what is allowed."""


@dataclass
class View:
    """What the checks look at in one tick; joint arrays are (J,)."""

    reading: np.ndarray
    """READING."""
    state: State
    now: int
    """ns."""
    target: np.ndarray
    """Joint targets of the order before, rad."""
    gravity: np.ndarray
    """Gravity's direction in the base frame of the postures that count, (K, 3)."""
    misses: int
    """Late ticks in a row."""


LIVE = frozenset(State) - {State.OFF}
KNOWN = frozenset((State.LYING, State.RISING, State.STANDING, State.POLICY, State.LOWERING))
"""The zeros of the joints are known, and the motors may give torque."""
UPRIGHT = KNOWN - {State.LYING}
SLOW = UPRIGHT - {State.POLICY}


@dataclass(frozen=True)
class _Check:
    name: str
    severity: Severity
    states: frozenset[State]
    test: Callable[[View], str]
    ticks: int = 1  # in a row before it counts


@dataclass
class Checks:
    """All checks of one robot under one policy.

    Attributes:
        metadata: Of the policy file.
        profile: Of the robot, with the numbers.
    """

    metadata: PolicyMetadata
    profile: Profile
    _seq: int = 0
    _counts: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Unpack the numbers of the policy file."""
        meta = self.metadata
        joints = meta.num_joints
        limits = meta.joint_limits or [(-np.inf, np.inf)] * joints
        self._low, self._high = np.array(limits).T
        self._speed = np.array(meta.velocity_limit or [np.inf] * joints)
        self._torque = np.array(meta.torque_limit)
        self._period = 1.0 / meta.control_rate
        self._pos = np.full(joints, np.nan)
        self._travel = np.zeros(joints)
        self._target = np.zeros(joints)
        self._power = 0.0
        self._table = self._list()

    def run(self, view: View) -> list[Finding]:
        """Return what is wrong now, the gravest first."""
        self._remember(view)
        findings = []
        for check in self._table:
            text = check.test(view) if view.state in check.states else ""
            count = self._counts.get(check.name, 0) + 1 if text else 0
            self._counts[check.name] = count
            if count >= check.ticks:
                findings.append(Finding(check.name, check.severity, text))
        return sorted(findings, key=lambda finding: -finding.severity)

    def refusal(self, view: View) -> str:
        """Return why the robot must not stand up now; empty if it may."""
        tests = (self._sane, self._fresh, self._motors, self._range, self._lean, self._imu)
        return next(filter(None, (test(view) for test in (*tests, self._heat, self._charge))), "")

    def _list(self) -> tuple[_Check, ...]:
        warn, lower, damp = Severity.WARN, Severity.LOWER, Severity.DAMP
        return (
            _Check("finite", damp, LIVE, self._sane),
            _Check("stale", damp, LIVE - {State.CONNECTED}, self._fresh),
            _Check("sequence", damp, LIVE, self._sequence),
            _Check("motor", damp, KNOWN, self._motors),
            _Check("driver", damp, LIVE, self._driver),
            _Check("tilt", damp, UPRIGHT, self._lean),
            _Check("range", damp, UPRIGHT, self._range, ticks=2),
            _Check("speed", damp, KNOWN, self._fast, ticks=2),
            _Check("torque", damp, KNOWN, self._strong, ticks=3),
            _Check("power", damp, UPRIGHT, self._powerful),
            _Check("frozen", damp, UPRIGHT, self._frozen),
            _Check("tracking", damp, SLOW, self._far, ticks=10),
            _Check("falling", damp, UPRIGHT, self._falls, ticks=round(0.2 / self._period)),
            _Check("temperature", lower, UPRIGHT, self._heat, ticks=25),
            _Check("battery", lower, UPRIGHT, self._charge, ticks=25),
            _Check("deadline", damp, UPRIGHT, lambda view: self._late(view, DAMPS)),
            _Check("late", lower, UPRIGHT, lambda view: self._late(view, LOWERS)),
            _Check("miss", warn, LIVE, lambda view: self._late(view, WARNS)),
            _Check("torn", warn, LIVE, self._torn),
        )

    def _remember(self, view: View) -> None:
        """Follow what needs more than one tick."""
        pos = self._joints(view, "joint_pos")
        travelled = self._travel + np.abs(view.target - self._target)
        still = (pos == self._pos) & (view.state in UPRIGHT)
        self._travel = np.where(still, travelled, 0.0)
        self._pos, self._target = pos, view.target.copy()
        pushed = np.maximum(self._joints(view, "torque") * self._joints(view, "joint_vel"), 0.0)
        share = min(1.0, self._period / self.profile.power_time)
        power = float(np.nan_to_num(pushed).sum())
        self._power += share * (power - self._power)

    def _joints(self, view: View, name: str) -> np.ndarray:
        return view.reading[name][: self.metadata.num_joints].astype(np.float64)

    def _sane(self, view: View) -> str:
        for name in ("joint_pos", "joint_vel", "torque", "quat", "gyro", "acc"):
            values = view.reading[name]
            if not np.isfinite(values).all() or np.abs(values).max() > LARGEST_READING:
                return f"{name} is {np.round(values, 3).tolist()}"
        norm = float(np.linalg.norm(view.reading["quat"]))
        return "" if 0.9 < norm < 1.1 else f"the orientation has length {norm:.2f}, not 1"

    def _fresh(self, view: View) -> str:
        age = (view.now - int(view.reading["time"])) / NANO
        most = self.profile.max_age * self._period
        if -self._period < age <= most:
            return ""
        return f"the last reading is {1000 * age:.0f} ms old, {1000 * most:.0f} are allowed"

    def _sequence(self, view: View) -> str:
        before, self._seq = self._seq, int(view.reading["seq"])
        return f"reading {self._seq} came after {before}" if self._seq < before else ""

    def _motors(self, view: View) -> str:
        flags = Flag(int(view.reading["flags"]))
        if flags & Flag.OTHER_CONTROLLER:
            return "another controller commands the motors"
        return "a motor's electronics report an error" if flags & Flag.MOTOR_ERROR else ""

    def _driver(self, view: View) -> str:
        return "the driver damps by itself" if view.reading["flags"] & Flag.LATCHED else ""

    def _torn(self, view: View) -> str:
        return (
            "messages of the robot are lost or damaged" if view.reading["flags"] & Flag.TORN else ""
        )

    def _lean(self, view: View) -> str:
        gravity = projected_gravity(view.reading["quat"].astype(np.float64))
        angle = _degrees(float((view.gravity @ gravity).max()))
        most = self.profile.max_tilt
        if angle <= most:
            return ""
        return f"{angle:.0f} degrees from the posture, {most:.0f} are allowed"

    def _range(self, view: View) -> str:
        pos = self._joints(view, "joint_pos")
        beyond = np.maximum(self._low - pos, pos - self._high)
        worst = int(np.argmax(beyond))
        stands, numbers = view.state in (State.STANDING, State.POLICY), self.profile
        if beyond[worst] <= (numbers.range_margin if stands else numbers.folded_margin):
            return ""
        return (
            f"{self.metadata.joint_names[worst]} is at {pos[worst]:.2f} rad, "
            f"{self._low[worst]:.2f} to {self._high[worst]:.2f} are allowed"
        )

    def _fast(self, view: View) -> str:
        return self._over(np.abs(self._joints(view, "joint_vel")), self._speed, "turns at", "rad/s")

    def _strong(self, view: View) -> str:
        limit = self.profile.torque_factor * self._torque
        return self._over(np.abs(self._joints(view, "torque")), limit, "gives", "N m")

    def _powerful(self, view: View) -> str:
        most = self.profile.max_power
        return "" if self._power <= most else f"{self._power:.0f} W, {most:.0f} are allowed"

    def _heat(self, view: View) -> str:
        degrees = np.nan_to_num(self._joints(view, "temperature"), nan=-np.inf)
        limit = self.profile.max_temperature
        if limit is None:
            return ""
        return self._over(degrees, np.full(len(degrees), limit), "is at", "degrees Celsius")

    def _charge(self, view: View) -> str:
        share, least = float(view.reading["battery"]), self.profile.min_battery or 0.0
        low = share < least  # false where it is not measured, for then it is NaN
        return f"the battery is at {100 * share:.0f} %, {100 * least:.0f} are needed" if low else ""

    def _frozen(self, view: View) -> str:
        worst = int(np.argmax(self._travel))
        if self._travel[worst] <= self.profile.frozen_travel:
            return ""
        name, way = self.metadata.joint_names[worst], self._travel[worst]
        return f"{name} tells the same angle while its target went {way:.2f} rad"

    def _far(self, view: View) -> str:
        error = np.abs(view.target - self._joints(view, "joint_pos"))
        most = np.full(len(error), self.profile.tracking_error)
        return self._over(error, most, "is off its target by", "rad")

    def _falls(self, view: View) -> str:
        force = float(np.linalg.norm(view.reading["acc"]))
        falls = force < self.profile.free_fall
        return f"{force:.1f} m/s^2 of specific force: falling freely" if falls else ""

    def _imu(self, view: View) -> str:
        """At rest the accelerometer shows up, where the orientation has to agree."""
        acc = view.reading["acc"].astype(np.float64)
        up = -projected_gravity(view.reading["quat"].astype(np.float64))
        cosine = acc @ up / max(float(np.linalg.norm(acc)), 1e-6)
        angle = _degrees(float(cosine))
        if angle <= self.profile.imu_error:
            return ""
        return (
            f"accelerometer and orientation disagree by {angle:.0f} degrees: check the IMU's axes"
        )

    def _late(self, view: View, place: int) -> str:
        late = view.misses >= self.profile.late_ticks[place]
        return f"{view.misses} ticks in a row came late" if late else ""

    def _over(self, values: np.ndarray, most: np.ndarray, verb: str, unit: str) -> str:
        worst = int(np.argmax(values - most))
        if values[worst] <= most[worst]:
            return ""
        name = self.metadata.joint_names[worst]
        return f"{name} {verb} {values[worst]:.2f} {unit}, {most[worst]:.2f} are allowed"


def _degrees(cosine: float) -> float:
    return float(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))))
