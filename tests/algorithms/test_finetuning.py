"""Terrain finetuning goes on with the networks of skill learning and is held near them."""

from __future__ import annotations

import pytest
import torch

from kiras_rl.algorithms.kiras import TASK
from kiras_rl.algorithms.losses import retention_loss, weights_of
from kiras_rl.algorithms.residual import Reference
from kiras_rl.phases import FINETUNING
from kiras_rl.schema import RetentionConfig


@pytest.fixture
def begin(make_runner):
    """Return a function that learns skills for two iterations and begins to finetune."""

    def make(*overrides):
        first = make_runner(*overrides)
        first.learn(2)
        second = make_runner(*overrides, phase=FINETUNING)
        second.alg.begin_from(first.alg.networks(), first.alg.save())
        return first.alg, second

    return make


def same(one, other):
    pairs = zip(one.state_dict().values(), other.state_dict().values(), strict=True)
    return all(torch.equal(a, b) for a, b in pairs)


@pytest.mark.parametrize("overrides", [(), ["learner.estimator=null"]], ids=str)
def test_it_begins_with_the_networks_of_skill_learning(begin, overrides):
    first, runner = begin(*overrides)
    alg = runner.alg
    assert same(first.actor.mlp, alg.actor.mlp)
    assert same(first.critic.critics[TASK], alg.critic.critics[TASK])
    assert same(first.policy(), alg.policy())
    assert same(first.policy(), alg.parts["retention"].policy)
    assert alg.learning_rate == first.learning_rate


def test_self_imitation_and_its_critic_are_gone(begin):
    alg = begin()[1].alg
    assert "imitation" not in alg.parts
    assert len(alg.critic.critics) == 1
    assert alg.storage.rewards.shape[-1] == 1


def test_skill_probabilities_go_on(begin):
    first, runner = begin()
    assert torch.equal(first.skill_probabilities, runner.alg.skill_probabilities)
    assert not torch.allclose(first.skill_probabilities, torch.tensor([0.5, 0.5]), atol=1e-5)


def test_the_reference_stays_while_the_policy_moves(begin):
    first, runner = begin()
    scalars = []
    runner.learn(2, on_iteration=lambda status: scalars.append(status.scalars))
    assert same(first.policy(), runner.alg.parts["retention"].policy)
    assert not same(runner.alg.policy(), runner.alg.parts["retention"].policy)
    assert scalars[0]["Residual/distance"] == pytest.approx(0.0, abs=1e-6)
    assert scalars[1]["Residual/distance"] > 1e-4


def test_the_residual_reward_is_the_distance_of_what_was_done(make_runner):
    alg = make_runner().alg
    obs = alg.storage.observations[0].clone()
    mean = alg.policy()(obs["proprio"], obs["history"])[0].detach()
    reference = Reference(RetentionConfig(0.15, 1.0), num_actions=2, reward_scale=0.02)
    reference.meet(alg.policy())
    away = mean + torch.tensor([0.3, -0.4])  # 0.5 from the reference
    flat, reward = reference.judge(obs, away)
    assert torch.allclose(reward, torch.tensor(-0.15 * 0.02 * 0.5), atol=1e-7)
    assert torch.allclose(flat, mean)


def test_the_loss_is_the_squared_distance_on_flat_ground():
    mean = torch.tensor([[0.3, -0.4], [1.0, 1.0], [0.0, 2.0]])
    flat = torch.tensor([True, False, True])
    weight, none = weights_of(flat), weights_of(flat & ~flat)
    assert retention_loss(mean, torch.zeros(3, 2), weight) == pytest.approx((0.25 + 4.0) / 2)
    assert retention_loss(mean, torch.zeros(3, 2), none) == 0.0


def test_on_flat_ground_the_policy_is_pulled_back(make_runner):
    """Nothing but the loss: no advantage, a policy away from its reference."""
    runner = make_runner("finetuning.retention.flat_loss_weight=100", phase=FINETUNING)
    runner.env.is_flat = torch.arange(16) % 2 == 0
    with torch.no_grad():
        runner.alg.actor.mlp[-1].bias += 0.5
    seen = []
    runner.learn(on_iteration=lambda status: seen.append(status.scalars))
    assert seen[0]["Residual/flat_distance"] > 0.6
    assert seen[-1]["Residual/flat_distance"] < 0.5 * seen[0]["Residual/flat_distance"]


def test_the_clock_counts_over_both_phases(begin):
    _, runner = begin()
    seen = []
    assert runner.learn(on_iteration=seen.append)
    assert [status.iteration for status in seen] == list(range(11, 21))
    assert {status.iterations for status in seen} == {20}
    assert runner.alg.progress == 1.0


def test_a_saved_finetuning_goes_on(begin):
    first, runner = begin()
    runner.learn(2)
    other = begin()[1]
    other.alg.load(runner.alg.save())
    assert same(other.alg.policy(), runner.alg.policy())
    assert same(other.alg.parts["retention"].policy, first.policy())
    assert other.alg.iteration == 2
