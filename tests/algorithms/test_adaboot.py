"""AdaBoot: trust from the spread of returns, and what it decides."""

from __future__ import annotations

import copy
import math

import pytest
import torch

from kiras_rl.algorithms.adaboot import AdaBoot, trust

WORLDS = 100


@pytest.fixture
def make_adaboot():
    """Return AdaBoot of WORLDS worlds in a mode."""
    return lambda mode, floor=0.0: AdaBoot(mode, floor, WORLDS, "cpu")


def finish_episodes(adaboot, rewards):
    """Let every world complete an episode of two steps with this mean reward."""
    adaboot.record(0.5 * rewards, torch.zeros(WORLDS))
    adaboot.record(1.5 * rewards, torch.ones(WORLDS))


@pytest.mark.parametrize(
    ("returns", "expected"),
    [
        ([2.0, 2.0, 2.0], 1.0),
        ([1.0, 2.0, 3.0], 1.0 - math.tanh(1.0 / 2.0)),  # standard deviation 1, mean 2
        ([-1.0, -2.0, -3.0], 0.0),
        ([0.0, 0.0, 0.0], 0.0),
    ],
)
def test_trust_falls_with_the_coefficient_of_variation(returns, expected):
    assert trust(torch.tensor(returns)).item() == pytest.approx(expected)


def test_episodes_count_by_their_mean_reward_whatever_their_length(make_adaboot):
    adaboot = make_adaboot("gate_update")
    dones = torch.zeros(4, WORLDS)
    dones[1, : WORLDS // 2] = 1  # half of the worlds end after two steps,
    dones[3] = 1  # all after four
    for done in dones:
        adaboot.record(torch.full((WORLDS,), 0.7), done)
    adaboot.renew()
    assert adaboot.probability.item() == pytest.approx(1.0)


def test_nothing_is_withheld_before_enough_episodes_are_known(make_adaboot):
    adaboot = make_adaboot("gate_update")
    ended = torch.arange(WORLDS) < 63
    adaboot.record(torch.full((WORLDS,), -1.0), ended)
    adaboot.renew()
    assert all(adaboot.update_allowed() for _ in range(20))


def test_one_world_alone_is_never_judged():
    adaboot = AdaBoot("both", 0.0, 1, "cpu")
    for _ in range(3):
        adaboot.record(torch.ones(1), torch.ones(1))
        adaboot.renew()
    assert adaboot.update_allowed()


def test_the_gate_opens_as_often_as_it_trusts(make_adaboot):
    adaboot = make_adaboot("gate_update", floor=0.1)
    finish_episodes(adaboot, torch.full((WORLDS,), -1.0))
    adaboot.renew()
    assert adaboot.probability.item() == 0.0
    opened = sum(adaboot.update_allowed() for _ in range(1000))
    assert opened == pytest.approx(100, abs=40)  # the floor; 4 standard deviations


def test_the_input_is_the_estimate_in_as_many_worlds_as_it_is_trusted(make_adaboot):
    adaboot = make_adaboot("bootstrap_input")
    assert not adaboot.uses_estimate.any()
    adaboot.renew()
    assert not adaboot.uses_estimate.any()
    finish_episodes(adaboot, torch.ones(WORLDS))
    adaboot.renew()
    assert adaboot.uses_estimate.all()
    assert adaboot.update_allowed()


def test_a_saved_state_goes_on(make_adaboot):
    adaboot, other = make_adaboot("both"), make_adaboot("both")
    finish_episodes(adaboot, torch.rand(WORLDS))
    adaboot.renew()
    other.load_state_dict(copy.deepcopy(adaboot.state_dict()))
    for each in (adaboot, other):
        torch.manual_seed(3)
        finish_episodes(each, torch.linspace(0, 1, WORLDS))
        each.renew()
    assert adaboot.probability == other.probability
    assert torch.equal(adaboot.uses_estimate, other.uses_estimate)
