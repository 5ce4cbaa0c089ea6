from __future__ import annotations

import numpy as np
import pytest

from kiras_rl.deploy.runtime.guard import HOLD, Guard
from kiras_rl.deploy.runtime.messages import NANO, ORDER, Mode

MS = NANO // 1000
NOW = 5 * NANO


def order(mode=Mode.SERVO, time=NOW, valid=40 * MS, target=0.1):
    made = np.zeros((), ORDER)
    made["seq"], made["time"], made["valid_until"], made["mode"] = 1, time, time + valid, mode
    made["target"] = target
    return made


def decide(guard, made, now, alive=True, emergency=False):
    return guard.decide(made, now, alive, emergency)


def test_motors_are_off_until_the_first_order():
    assert decide(Guard(), None, NOW) == Mode.OFF


def test_a_late_order_is_held_and_then_damped():
    guard, made = Guard(), order()
    modes = [decide(guard, made, NOW + ms * MS) for ms in range(0, 200, 5)]
    held = round(1000 * HOLD)
    expected = [
        Mode.SERVO if ms <= 40 else Mode.HOLD if ms <= 40 + held else Mode.DAMP
        for ms in range(0, 200, 5)
    ]
    assert modes == expected


def test_an_order_that_comes_back_in_time_ends_the_hold():
    guard = Guard()
    decide(guard, order(), NOW)
    assert decide(guard, order(), NOW + 60 * MS) == Mode.HOLD
    assert decide(guard, order(time=NOW + 70 * MS), NOW + 70 * MS) == Mode.SERVO


def test_damping_is_latched_until_the_runtime_itself_orders_it():
    guard = Guard()
    decide(guard, order(), NOW)
    assert decide(guard, order(), NOW + NANO) == Mode.DAMP
    late = NOW + NANO + MS
    assert decide(guard, order(time=late), late) == Mode.DAMP
    assert guard.reason.startswith("no order for")
    assert decide(guard, order(Mode.DAMP, late + MS), late + MS) == Mode.DAMP
    assert guard.reason == ""
    assert decide(guard, order(time=late + 2 * MS), late + 2 * MS) == Mode.SERVO


@pytest.mark.parametrize("cause", [{"alive": False}, {"emergency": True}])
def test_a_runtime_that_is_gone_or_a_button_damps_in_the_same_tick(cause):
    guard = Guard()
    assert decide(guard, order(), NOW) == Mode.SERVO
    assert decide(guard, order(), NOW + MS, **cause) == Mode.DAMP
    assert decide(guard, order(time=NOW + 2 * MS), NOW + 2 * MS) == Mode.DAMP


def test_an_order_with_numbers_that_are_not_finite_does_not_count():
    guard = Guard()
    decide(guard, order(), NOW)
    assert decide(guard, order(time=NOW + MS, target=np.nan), NOW + MS) == Mode.SERVO
    assert np.allclose(guard.order["target"], 0.1)


def test_an_older_order_does_not_replace_a_newer_one():
    guard = Guard()
    decide(guard, order(time=NOW, target=0.3), NOW)
    decide(guard, order(time=NOW - 20 * MS, target=0.5), NOW + MS)
    assert np.allclose(guard.order["target"], 0.3)


def test_an_order_of_the_future_does_not_count():
    guard = Guard()
    decide(guard, order(target=0.3), NOW)
    decide(guard, order(time=NOW + NANO, target=0.5), NOW + MS)
    assert np.allclose(guard.order["target"], 0.3)


def test_a_clock_that_goes_back_damps():
    guard = Guard()
    decide(guard, order(), NOW)
    assert decide(guard, order(), NOW - NANO) == Mode.DAMP
