"""Advantages of groups against rsl-rl's own, one group at a time."""

from __future__ import annotations

import pytest
import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

from kiras_rl.algorithms.returns import generalized_advantages, mix_advantages

STEPS, WORLDS, GAMMA, LAM = 6, 5, 0.97, 0.9


@pytest.fixture
def rollout():
    """A rollout of two groups with some episodes ending in it."""
    rewards, values = torch.randn(2, STEPS, WORLDS, 2).unbind()
    dones = (torch.rand(STEPS, WORLDS, 1) < 0.2).to(torch.uint8)
    assert 0 < dones.sum() < dones.numel()
    return rewards, values, torch.randn(WORLDS, 2), dones


def stock_ppo(rewards, values, dones):
    """rsl-rl's PPO over one group of the rollout: its learner, and the observation after it."""
    obs = TensorDict({"state": torch.randn(WORLDS, 3)}, batch_size=[WORLDS])
    groups = {"actor": ["state"], "critic": ["state"]}
    distribution = {"class_name": "GaussianDistribution", "init_std": 1.0, "std_type": "log"}
    actor = MLPModel(obs, groups, "actor", 2, [4], "elu", False, distribution)
    critic = MLPModel(obs, groups, "critic", 1, [4], "elu")
    storage = RolloutStorage("rl", WORLDS, STEPS, obs, [2])
    storage.rewards[:], storage.values[:], storage.dones[:] = rewards, values, dones
    return PPO(actor, critic, storage, gamma=GAMMA, lam=LAM), obs


def test_each_group_gets_rsl_rl_s_returns_and_normalised_advantages(rollout):
    rewards, values, last, dones = rollout
    for g, weights in enumerate([(1.0, 0.0), (0.0, 1.0)]):
        ppo, obs = stock_ppo(rewards[..., g : g + 1], values[..., g : g + 1], dones)
        last[:, g] = ppo.critic(obs).detach().squeeze(1)
        ppo.compute_returns(obs)
        advantages = generalized_advantages(rewards, values, last, dones, GAMMA, LAM)
        torch.testing.assert_close(
            (advantages + values)[..., g : g + 1], ppo.storage.returns, atol=1e-6, rtol=0
        )
        mixed = mix_advantages(advantages, weights, std_floor=1e-3)
        torch.testing.assert_close(mixed, ppo.storage.advantages, atol=2e-6, rtol=0)


def test_an_end_cuts_what_comes_after_it():
    rewards, values = torch.tensor([1.0, 2.0, 4.0]), torch.tensor([0.5, 1.0, 2.0])
    dones = torch.tensor([0, 1, 0])
    advantages = generalized_advantages(
        rewards.view(3, 1, 1), values.view(3, 1, 1), torch.tensor([[8.0]]), dones.view(3, 1, 1),
        gamma=0.5, lam=0.5,
    )  # fmt: skip
    # last step: 4 + .5 * 8 - 2 = 6; at the end: 2 - 1 = 1; first: 1 + .5 * 1 - .5 + .25 * 1 = 1.25
    assert advantages.flatten().tolist() == [1.25, 1.0, 6.0]


def test_groups_are_normalised_before_they_are_weighed():
    advantages = torch.tensor([[[0.0, 100.0]], [[2.0, 300.0]]])
    # each group is (-1, 1) / sqrt(2) after normalisation, whatever its scale
    expected = torch.tensor([-1.0, 1.0]).mul(2**-0.5).view(2, 1, 1)
    torch.testing.assert_close(mix_advantages(advantages, (0.3, 0.7), 1e-3), expected)


def test_a_group_that_does_not_vary_is_not_blown_up():
    dead = 1e-6 * torch.randn(STEPS, WORLDS, 1)
    assert mix_advantages(dead, (1.0,), std_floor=1e-3).abs().max() < 5e-3
