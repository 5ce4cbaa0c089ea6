"""How feet step, on contacts that can be counted by eye."""

from __future__ import annotations

import pytest
import torch

from kiras_rl.evaluation.gait import clearance, lifts_per_second

DT = 0.1


def test_lifts_are_counted_by_foot():
    stands = torch.ones(20, 1, 3, dtype=torch.bool)
    stands[1::4, :, 0] = False  # 5 lifts in 2 s
    stands[1::2, :, 1] = False
    stands[5:9, :, 2] = False  # one lift
    alive = torch.ones(20, 1, dtype=torch.bool)
    assert lifts_per_second(stands, alive, DT).tolist() == [[2.5, 5.0, 0.5]]


def test_a_fallen_robot_lifts_no_feet():
    stands = torch.ones(20, 1, 1, dtype=torch.bool)
    stands[1::4] = False  # steps 1 and 5, then after the fall 9, 13, 17
    alive = (torch.arange(20) < 8)[:, None]
    assert lifts_per_second(stands, alive, DT).item() == pytest.approx(2 / 0.8)
    assert lifts_per_second(stands, alive & False, DT).tolist() == [[0.0]]


def swings(*stands):
    """Return the steps of one robot with one foot, (T, 1, 1) bool."""
    return torch.tensor(stands, dtype=torch.bool)[:, None, None]


def test_the_largest_height_of_each_whole_swing_counts():
    stands = swings(0, 1, 0, 0, 1, 1, 0, 1, 0)  # the first and the last are cut off
    height = torch.tensor([9.0, 0.0, 0.02, 0.03, 0.0, 0.0, 0.05, 0.0, 9.0])[:, None, None]
    total, number = clearance(stands, height, torch.ones(9, 1, dtype=torch.bool))
    assert total.item() == pytest.approx(0.03 + 0.05)
    assert number.item() == 2


def test_swings_outside_the_steps_that_count_are_left_out():
    stands = swings(1, 0, 1, 0, 0, 1, 0, 1)
    height = torch.full((8, 1, 1), 0.02)
    counted = torch.tensor([False, False, False, False, True, True, True, False])[:, None]
    total, number = clearance(
        stands, height, counted
    )  # the second began before, the third ends after
    assert (total.item(), number.item()) == (0.0, 0.0)
    total, number = clearance(stands, height, counted | torch.tensor([[False]] * 3 + [[True]] * 5))
    assert number.item() == 2


def test_a_foot_that_never_lifts_has_no_swing():
    total, number = clearance(swings(*[1] * 9), torch.zeros(9, 1, 1), torch.ones(9, 1) > 0)
    assert (total.item(), number.item()) == (0.0, 0.0)
