"""Every check by a reading that has one thing wrong."""

from __future__ import annotations

import numpy as np
import pytest

from kiras_rl.deploy.profile import Profile
from kiras_rl.deploy.runtime.checks import Checks, Severity, View
from kiras_rl.deploy.runtime.messages import NANO, Flag, State, make_reading
from kiras_rl.robots.robot import load_robot

PERIOD = NANO // 50
LEVEL = np.array([[0.0, 0.0, -1.0]])
ON_ITS_BACK = (0.0, 1.0, 0.0, 0.0)


@pytest.fixture
def metadata(make_metadata):
    return make_metadata()


@pytest.fixture
def checks(metadata):
    return Checks(metadata, profile("go1"))  # a robot that measures temperature and battery


def profile(robot, **changes):
    return Profile.from_dict({**load_robot(robot).onboard, **changes})


class Ticks:
    """Feeds readings of a robot that stands, one a control period."""

    def __init__(self, checks, metadata, state=State.STANDING):
        self.checks, self.state, self.now, self.misses = checks, state, NANO, 0
        self.target = np.array(metadata.default_joint_pos)
        self.reading = make_reading()
        self.reading["joint_pos"][:8] = self.target
        self.reading["acc"] = 0.0, 0.0, 9.81
        self.random = np.random.default_rng(0)

    def view(self):
        return View(self.reading, self.state, self.now, self.target, LEVEL, self.misses)

    def step(self, moves=True, arrives=True):
        self.now += PERIOD
        if arrives:
            self.reading["seq"] += 1
            self.reading["time"] = self.now
        if moves:
            self.reading["joint_pos"][:8] = self.target + self.random.normal(0, 1e-3, 8)
        return self.checks.run(self.view())

    def until_found(self, most=60, **how):
        for tick in range(1, most + 1):
            if found := self.step(**how):
                return tick, found[0]
        raise AssertionError("nothing was found")


def test_a_robot_that_stands_well_passes(checks, metadata):
    ticks = Ticks(checks, metadata)
    assert [ticks.step() for _ in range(200)] == [[]] * 200


FAULTS = {
    # name: field, joint or None, value, ticks until it counts, consequence
    "finite": ("joint_vel", 3, np.nan, 1, Severity.DAMP),
    "motor": ("flags", None, Flag.MOTOR_ERROR, 1, Severity.DAMP),
    "driver": ("flags", None, Flag.LATCHED, 1, Severity.DAMP),
    "torn": ("flags", None, Flag.TORN, 1, Severity.WARN),
    "tilt": ("quat", None, (0.8, 0.6, 0.0, 0.0), 1, Severity.DAMP),  # 74 degrees of roll
    "speed": ("joint_vel", 2, 81.0, 2, Severity.DAMP),  # 80 are allowed
    "torque": ("torque", 1, 2.2, 3, Severity.DAMP),  # 1.8 are
    "falling": ("acc", None, (0.0, 0.0, 0.5), 10, Severity.DAMP),
    "temperature": ("temperature", 4, 76.0, 25, Severity.LOWER),
    "battery": ("battery", None, 0.09, 25, Severity.LOWER),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_found_by_its_name_in_time(name, checks, metadata):
    field, joint, value, expected, severity = FAULTS[name]
    ticks = Ticks(checks, metadata)
    ticks.step()
    if joint is None:
        ticks.reading[field] = value
    else:
        ticks.reading[field][joint] = value
    tick, found = ticks.until_found()
    assert (found.name, found.severity, tick) == (name, severity, expected)
    if joint is not None and name != "finite":
        assert metadata.joint_names[joint] in found.text


def test_a_joint_beyond_its_range_is_found(checks, metadata):
    ticks = Ticks(checks, metadata)
    ticks.target = ticks.target.copy()
    ticks.target[0] = 1.58  # FL_HFE: 1.45 and 0.1 of margin
    tick, found = ticks.until_found()
    assert (tick, found.name) == (2, "range")
    assert found.text == "FL_HFE is at 1.58 rad, -1.45 to 1.45 are allowed"


@pytest.mark.parametrize(("angle", "refused"), [(3.15, False), (3.25, True)])  # 2.80 and 0.4
def test_legs_that_lie_fold_farther_than_a_policy_may_bend_them(checks, metadata, angle, refused):
    ticks = Ticks(checks, metadata, state=State.CALIBRATED)
    ticks.reading["time"] = ticks.now
    ticks.reading["joint_pos"][1] = angle  # FL_KFE
    why = checks.refusal(ticks.view())
    assert (why == f"FL_KFE is at {angle:.2f} rad, -2.80 to 2.80 are allowed") is refused
    assert bool(why) is refused


def test_a_reading_that_is_old_is_found_after_two_periods(checks, metadata):
    ticks = Ticks(checks, metadata)
    ticks.step()
    tick, found = ticks.until_found(arrives=False)
    assert (tick, found.name) == (3, "stale")


def test_a_reading_that_comes_after_a_newer_one_is_found(checks, metadata):
    ticks = Ticks(checks, metadata)
    for _ in range(5):
        ticks.step()
    ticks.reading["seq"] -= 3
    assert ticks.step()[0].name == "sequence"


def test_power_is_the_mean_over_half_a_second(checks, metadata):
    ticks = Ticks(checks, metadata)
    ticks.reading["torque"][:8], ticks.reading["joint_vel"][:8] = 1.7, 79.0  # 1074 W, 700 allowed
    tick, found = ticks.until_found()
    # 1 - 0.96^n first exceeds 700 / 1074 at n = 26
    assert (found.name, tick) == ("power", 26)


def test_an_encoder_that_does_not_change_is_found_once_its_target_has(checks, metadata):
    ticks = Ticks(checks, metadata, State.POLICY)
    ticks.step()
    for tick in range(1, 20):
        ticks.target = ticks.target + np.where(np.arange(8) == 5, 0.15 * (-1) ** tick, 0.0)
        stuck = ticks.reading["joint_pos"][5].copy()
        ticks.reading["joint_pos"][:8] += 1e-3
        ticks.reading["joint_pos"][5] = stuck
        if found := ticks.step(moves=False):
            break
    assert (found[0].name, tick) == ("frozen", int(0.5 / 0.15) + 1)
    assert metadata.joint_names[5] in found[0].text


def test_a_joint_that_does_not_follow_a_slow_target_is_found(checks, metadata):
    ticks = Ticks(checks, metadata, State.RISING)
    ticks.step()
    ticks.target = ticks.target + np.where(np.arange(8) == 6, 0.7, 0.0)
    found, tick = [], 0
    while not found and tick < 20:
        tick += 1
        ticks.reading["joint_pos"][:8] += ticks.random.normal(0, 1e-4, 8)
        found = ticks.step(moves=False)
    assert (found[0].name, tick) == ("tracking", 10)


CHANGED = {
    # number: another value, and a reading that it makes a fault of, or no fault any more
    "max_age": (4.0, None, None, None, ""),
    "max_tilt": (20.0, "quat", None, (0.97, 0.24, 0.0, 0.0), "tilt"),  # 28 degrees of roll
    "range_margin": (0.0, "joint_pos", 0, 1.46, "range"),
    "torque_factor": (1.0, "torque", 1, 1.9, "torque"),
    "free_fall": (5.0, "acc", None, (0.0, 0.0, 4.0), "falling"),
    "max_temperature": (50.0, "temperature", 4, 60.0, "temperature"),
    "min_battery": (0.5, "battery", None, 0.4, "battery"),
    "late_ticks": ([5, 6, 7], "misses", None, 4, ""),
}


@pytest.mark.parametrize("name", CHANGED)
def test_numbers_are_the_profile_s(name, metadata):
    value, field, joint, measured, expected = CHANGED[name]

    def found_with(numbers):
        ticks = Ticks(Checks(metadata, numbers), metadata)
        ticks.target = ticks.target.copy()
        ticks.step()
        if field == "misses":
            ticks.misses = measured
        elif field == "joint_pos":
            ticks.target[joint] = measured
        elif joint is not None:
            ticks.reading[field][joint] = measured
        elif field is not None:
            ticks.reading[field] = measured
        arrives = name != "max_age"
        found = [ticks.step(arrives=arrives) for _ in range(60 if arrives else 4)]
        return {finding.name for findings in found for finding in findings}

    usual, changed = found_with(profile("go1")), found_with(profile("go1", **{name: value}))
    assert changed == ({expected} if expected else set())
    assert bool(usual) is not bool(changed)


@pytest.mark.parametrize(
    ("misses", "name", "severity"),
    [
        (1, "miss", Severity.WARN),
        (3, "late", Severity.LOWER),
        (10, "deadline", Severity.DAMP),
    ],
)
def test_late_ticks_in_a_row_have_consequences(checks, metadata, misses, name, severity):
    ticks = Ticks(checks, metadata)
    ticks.misses = misses
    found = ticks.step()[0]
    assert (found.name, found.severity) == (name, severity)


def test_what_was_not_measured_is_not_judged(metadata):
    ticks = Ticks(Checks(metadata, profile("solo8")), metadata)
    assert np.isnan(ticks.reading["battery"])
    assert np.isnan(ticks.reading["temperature"]).all()
    assert all(ticks.step() == [] for _ in range(60))


@pytest.mark.parametrize(
    ("field", "value", "why"),
    [
        ("quat", ON_ITS_BACK, "180 degrees from the posture"),
        ("acc", (0.0, 0.0, -9.81), "disagree by 180 degrees: check the IMU"),
        ("battery", 0.05, "the battery is at 5 %"),
        ("flags", Flag.OTHER_CONTROLLER, "another controller"),
    ],
)
def test_standing_up_is_refused(checks, metadata, field, value, why):
    ticks = Ticks(checks, metadata, State.LYING)
    ticks.step()
    assert checks.refusal(ticks.view()) == ""
    ticks.reading[field] = value
    assert why in checks.refusal(ticks.view())
