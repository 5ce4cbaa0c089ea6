"""Transitions are judged on a robot whose every height is known."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from kiras_rl.evaluation.transitions import (
    evaluate_transitions,
    overshoot,
    pairs_of,
    roughness,
    settle_times,
)


def stand(obs):
    """Ask for nothing."""
    return torch.zeros(12, 8)


HEIGHTS = torch.tensor([0.2, 0.1, 0.3])


class Jumper:
    """Stands at its skill's height at once; worlds that begin in `stuck` never leave 0.5 m."""

    skills = ("walk", "crawl", "stilt")
    step_dt = 0.02
    device = torch.device("cpu")
    keyframe_height = HEIGHTS
    keyframe_pitch = torch.zeros(3)

    def __init__(self, num_envs, stuck=None, falls_into=None):
        self.num_envs, self.stuck, self.falls_into = num_envs, stuck, falls_into

    def seed(self, seed):
        pass

    def reset(self, skill, command):
        self.first = self.skill = skill

    def set_task(self, skill, command):
        self.skill = skill

    def step(self, actions):
        return None, None, None, None

    def measure(self):
        height = HEIGHTS[self.skill].clone()
        if self.stuck is not None:
            height[self.first == self.stuck] = 0.5
        fallen = torch.zeros(self.num_envs, dtype=torch.bool)
        if self.falls_into is not None:
            fallen = (self.skill == self.falls_into) & (self.first != self.falls_into)
        nothing = torch.zeros(self.num_envs)
        still = torch.zeros(self.num_envs, 3)
        return SimpleNamespace(base_height=height, pitch=nothing, lin_vel_h=still, fallen=fallen)


def test_every_ordered_pair_is_tried():
    first, second = pairs_of(3, trials=2)
    pairs = sorted(set(zip(first.tolist(), second.tolist(), strict=True)))
    assert pairs == [(0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)]
    assert len(first) == 12


def test_settled_is_the_first_moment_from_which_both_bands_hold_for_long_enough():
    within = torch.zeros(100, 3, dtype=torch.bool)
    within[10:, 0] = True
    within[5:19, 1] = True  # 14 steps: less than 0.3 s
    within[40:, 1] = True
    torch.testing.assert_close(settle_times(within, 0.02), torch.tensor([0.2, 0.8, float("inf")]))


def test_a_perfect_robot_settles_everywhere_after_the_lag_of_the_average():
    result = evaluate_transitions(Jumper(12), stand, trials=2, command=0.3)
    assert result.overall() == (0.0, 1.0)
    # From 0.2 to 0.1 m the mean of 20 steps is within 1.5 cm after 18 of them: at step 17.
    assert result.settle_time[0, 1] == pytest.approx(17 * 0.02, abs=0.021)


def test_a_robot_that_never_took_the_first_skill_has_not_changed_from_it():
    result = evaluate_transitions(Jumper(12, stuck=2), stand, trials=2, command=0.3)
    assert result.settled[2, :2].tolist() == [0.0, 0.0]
    assert result.settled[0, 1] == 1.0


def test_falls_are_counted_by_pair():
    result = evaluate_transitions(Jumper(12, falls_into=1), stand, trials=2, command=0.3)
    assert result.fell[0, 1] == 1.0
    assert result.settled[0, 1] == 0.0
    assert result.fell[1, 0] == 0.0


def test_a_wrong_number_of_worlds_is_refused():
    with pytest.raises(ValueError, match="12 worlds needed, 10 given"):
        evaluate_transitions(Jumper(10), stand, trials=2, command=0.3)


def test_overshoot_is_what_lies_beyond_the_goal_on_the_way_to_it():
    start, goal = torch.tensor([0.2, 0.2, 0.2]), torch.tensor([0.3, 0.1, 0.3])
    signal = torch.tensor([[0.2, 0.2, 0.2], [0.33, 0.08, 0.29], [0.3, 0.12, 0.28]])
    torch.testing.assert_close(overshoot(signal, start, goal), torch.tensor([0.03, 0.02, 0.0]))


def test_roughness_compares_the_largest_change_after_with_that_before():
    changes = torch.zeros(8, 1, 2)
    changes[2, 0] = torch.tensor([3.0, 4.0])  # 5
    changes[5, 0] = torch.tensor([0.0, 15.0])
    changes[7, 0] = 100.0  # too late
    torch.testing.assert_close(roughness(changes, switch=4, near=3), torch.tensor([3.0]))
