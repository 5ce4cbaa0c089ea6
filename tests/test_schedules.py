"""Schedules at points that can be computed in the head."""

from __future__ import annotations

import pytest

from kiras_rl.schedules import advantage_weights, piecewise_linear


def test_a_schedule_is_linear_between_its_points_and_constant_outside():
    points = [[0.2, 4.0], [0.6, 2.0], [0.8, 2.0], [1.0, 0.0]]
    progress = [0.0, 0.2, 0.3, 0.4, 0.7, 0.95, 1.0, 5.0]
    expected = [4.0, 4.0, 3.5, 3.0, 2.0, 0.5, 0.0, 0.0]
    assert [piecewise_linear(points, p) for p in progress] == pytest.approx(expected)


def test_a_schedule_of_one_point_is_constant():
    assert piecewise_linear([[0.5, 3.0]], 0.1) == piecewise_linear([[0.5, 3.0]], 0.9) == 3.0


def test_a_schedule_may_jump():
    points = [[0.0, 1.0], [0.5, 1.0], [0.5, 2.0], [1.0, 2.0]]
    assert piecewise_linear(points, 0.49) == 1.0
    assert piecewise_linear(points, 0.51) == 2.0


@pytest.mark.parametrize("points", [[], [[0.5, 1.0], [0.0, 2.0]]])
def test_points_out_of_order_are_refused(points):
    with pytest.raises(ValueError, match="ascending order"):
        piecewise_linear(points, 0.5)


@pytest.mark.parametrize(
    ("progress", "floor", "omega1"),
    [
        (0.0, 0.0, 0.4),  # 1 - sigma
        (0.5, 0.0, 0.7),  # sigma / 2 + 1 - sigma
        (1.0, 0.0, 1.0),
        (2.0, 0.0, 1.0),
        (1.0, 0.25, 0.75),  # 1 - floor
        (0.5, 0.25, 0.7),
        (0.0, 0.9, 0.1),
    ],
)
def test_weights_move_from_imitation_to_the_task(progress, floor, omega1):
    weights = advantage_weights(progress, sigma=0.6, omega2_floor=floor)
    assert weights == pytest.approx((omega1, 1.0 - omega1))
