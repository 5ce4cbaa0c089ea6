"""How punctual a loop was, from times that are given."""

from __future__ import annotations

import pytest

from kiras_rl.deploy.runtime.pace import Pace, Times

MS = 1_000_000


def test_quantiles_are_those_of_the_durations():
    times = Times()
    for duration in range(1, 101):
        times.add(duration * MS // 10)  # 0.1 to 10 ms
    assert times.count == 100
    assert times.quantile(0.5) == pytest.approx(5.0, abs=0.02)
    assert times.quantile(0.99) == pytest.approx(9.9, abs=0.02)
    assert times.line() == "p50 5.01, p99 9.91, max 10.00 ms"


def test_what_is_longer_than_the_memory_shows_in_the_maximum():
    times = Times()
    times.add(3_000 * MS)
    assert times.largest == 3_000 * MS
    assert times.quantile(0.5) == pytest.approx(100.0)


def test_a_tick_that_takes_too_long_is_a_miss_though_the_next_is_not_late():
    pace = Pace(20 * MS)
    pace.add(0, 20 * MS)
    pace.add(0, 29 * MS)
    assert pace.misses == 0
    pace.add(0, 55 * MS)
    pace.add(11 * MS, 25 * MS)
    assert (pace.ticks, pace.misses) == (4, 2)
    assert pace.line().startswith("4 ticks late by p50 0.01")
    assert pace.line().endswith("max 55.00 ms; 2 misses")
