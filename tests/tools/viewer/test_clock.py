"""Real time: kept where it can be, not chased where it is lost."""

from __future__ import annotations

import pytest

from kiras_rl.tools.driving.viewer.clock import Clock


class World:
    """A time that passes by sleeping and working."""

    def __init__(self):
        self.time = 0.0

    def now(self):
        return self.time

    def work(self, seconds):
        self.time += seconds


@pytest.fixture
def world():
    return World()


@pytest.fixture
def clock(world):
    return Clock(world.now, world.work)


def test_work_does_not_add_to_the_period(world, clock):
    for _ in range(100):
        world.work(0.015)
        clock.wait(0.02)
    assert world.time == pytest.approx(2.0)


def test_a_short_delay_is_caught_up(world, clock):
    world.work(0.1)
    for _ in range(10):
        clock.wait(0.02)
    assert world.time == pytest.approx(0.2)


def test_a_long_delay_is_dropped(world, clock):
    world.work(3.0)
    for _ in range(11):
        clock.wait(0.02)
    assert world.time == pytest.approx(3.2)


def test_the_factor_says_how_much_was_kept(world, clock):
    for _ in range(200):
        world.work(0.04)
        clock.wait(0.02)
    assert clock.real_time == pytest.approx(0.5, abs=0.02)
    for _ in range(300):
        clock.wait(0.02)
    assert clock.real_time == pytest.approx(1.0, abs=0.02)
