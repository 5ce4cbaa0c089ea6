"""Slow pictures are drawn with less in them, and with all again where there is time for it."""

from __future__ import annotations

import pytest

from kiras_rl.tools.driving.viewer.detail import LEVELS, Detail


class Clock:
    """A time that stands still until it is set."""

    seconds = 100.0

    def __call__(self):
        """Return the time, s."""
        return self.seconds


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def detail(clock):
    return Detail(now=clock)


def test_all_is_drawn_where_pictures_come_in_time(detail):
    for _ in range(5):
        detail.judge(30.0)
    assert detail.level == LEVELS[0] and not detail.is_reduced


def test_slow_pictures_lose_a_level_and_the_scene_may_settle_first(detail):
    detail.judge(8.0)
    assert detail.level == LEVELS[1]
    detail.judge(0.3)  # while the scene is built
    assert detail.level == LEVELS[1]
    detail.judge(8.0)
    assert detail.level == LEVELS[2]
    for _ in range(4):
        detail.judge(1.0)
    assert detail.level == LEVELS[-1]


def test_pictures_that_are_of_no_use_lose_all_levels_at_once(detail):
    detail.judge(0.5)
    assert detail.level == LEVELS[-1]


def test_more_is_tried_again_after_a_while_where_pictures_are_fast(detail, clock):
    detail.judge(0.5)
    detail.judge(60.0)
    clock.seconds += 59.0
    detail.judge(60.0)
    assert detail.level == LEVELS[-1]
    clock.seconds += 2.0
    detail.judge(60.0)
    assert detail.level == LEVELS[-2]


def test_a_picture_for_a_page_of_the_documentation_keeps_all(clock):
    detail = Detail(LEVELS[:1], clock)
    detail.judge(0.1)
    assert detail.level == LEVELS[0]
