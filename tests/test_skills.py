"""Skill probabilities against the paper's formula, and where the formula fails."""

from __future__ import annotations

import pytest
import torch

from kiras_rl.schema import SkillInitConfig
from kiras_rl.skills import SkillSampler, cover_all_skills, skill_probabilities


def test_positive_values_give_the_paper_s_formula():
    values = torch.tensor([1.0, 2.0, 3.0, 4.0, 10.0])
    expected = torch.tensor([19 / 20, 18 / 20, 17 / 20, 16 / 20, 10 / 20]) / 4
    torch.testing.assert_close(skill_probabilities(values, floor=0.05), expected)


@pytest.mark.parametrize(
    "values",
    [
        [-1.0, -2.0, -3.0, -0.5, -4.0],  # the formula alone would turn the ranking round
        [10.0, -4.0, -4.5, 1.0, 0.5],  # ... and give p outside [0, 1]
        [2.0, -2.0, 1.0, -1.0, 0.0],  # ... and divide by zero
    ],
)
def test_the_worst_skill_is_drawn_most_often_whatever_the_sign(values):
    values = torch.tensor(values)
    probabilities = skill_probabilities(values, floor=0.01)
    assert probabilities.sum() == pytest.approx(1.0)
    assert probabilities.argsort(descending=True).tolist() == values.argsort().tolist()


@pytest.mark.parametrize("value", [0.0, 3.0, -3.0])
def test_equal_values_are_drawn_equally(value):
    probabilities = skill_probabilities(torch.full((4,), value), floor=0.05)
    torch.testing.assert_close(probabilities, torch.full((4,), 0.25))


def test_no_skill_falls_below_the_floor():
    probabilities = skill_probabilities(torch.tensor([100.0, 1.0, 1.0, 1.0, 1.0]), floor=0.05)
    assert probabilities.min() == pytest.approx(0.05)
    assert probabilities.sum() == pytest.approx(1.0)


def test_the_probabilities_hardly_jump_where_a_value_turns_negative():
    above, below = (
        skill_probabilities(torch.tensor([v, 1.0, 2.0]), floor=0.0) for v in (1e-6, -1e-6)
    )
    torch.testing.assert_close(above, below, atol=2e-3, rtol=0)


def test_a_skill_that_nobody_practised_gets_the_chance_of_the_most_practised():
    covered = cover_all_skills(torch.tensor([0.5, 0.4, 0.1]), torch.tensor([30.0, 70.0, 0.0]))
    torch.testing.assert_close(covered, torch.tensor([0.5, 0.4, 0.4]) / 1.3)


def test_the_sampler_follows_slowly():
    sampler = SkillSampler(SkillInitConfig(floor=0.0, smoothing=0.9), 3, "cpu")
    torch.testing.assert_close(sampler.probabilities, torch.full((3,), 1 / 3))
    sampler.choose_skills(torch.tensor([1.0, 2.0, 3.0]), practised=torch.ones(3))
    new = torch.tensor([5 / 12, 4 / 12, 3 / 12])
    torch.testing.assert_close(sampler.probabilities, 0.9 / 3 + 0.1 * new)


def test_one_skill_is_always_drawn():
    sampler = SkillSampler(SkillInitConfig(floor=0.05, smoothing=0.9), 1, "cpu")
    sampler.choose_skills(torch.tensor([2.0]), practised=torch.ones(1))
    assert sampler.probabilities.tolist() == [1.0]
