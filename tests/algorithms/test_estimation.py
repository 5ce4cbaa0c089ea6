"""The context estimator: what it learns from, and whom the actor believes."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from kiras_rl import interfaces as names
from kiras_rl.algorithms.estimation import Estimation
from kiras_rl.algorithms.part import Iteration, Outcome
from kiras_rl.algorithms.storage import GroupRolloutStorage
from kiras_rl.config import ConfigError
from kiras_rl.models.estimator import ContextEstimator
from kiras_rl.schema import EstimatorConfig

STEPS, WORLDS, PROPRIO, FRAMES, SKILLS, LATENT = 8, 64, 4, 2, 2, 3
RATE = torch.tensor(3e-3)  # of the actor
ONE, FOUR = (Iteration(number=0, mini_batches=count, actor_rate=RATE) for count in (1, 4))


@pytest.fixture
def make_estimation():
    """Return a function that builds a small estimator in an AdaBoot mode."""

    def make(adaboot="off", floor=0.0):
        config = EstimatorConfig(
            latent_dim=LATENT, encoder_dims=[32], decoder_dims=[32], relative_step=1.0,
            epochs=1, kl_weight=0.01, prior_weight=1e-3, adaboot=adaboot, adaboot_floor=floor,
        )  # fmt: skip
        network = ContextEstimator(PROPRIO, FRAMES, SKILLS, LATENT, [32], [32])
        return Estimation(config, network, WORLDS, "cpu")

    return make


@pytest.fixture
def storage():
    """A rollout in which the history tells the velocity, and a tenth of the episodes end."""
    history = torch.randn(STEPS, WORLDS, FRAMES * PROPRIO)
    groups = {
        names.HISTORY: history,
        names.VELOCITY: history[..., :3] - history[..., 3:6],
        names.NEXT_PROPRIO: torch.zeros(STEPS, WORLDS, PROPRIO),
        names.SKILL: torch.eye(SKILLS)[torch.arange(WORLDS) % SKILLS].expand(STEPS, -1, -1),
    }
    obs = TensorDict(groups, batch_size=[STEPS, WORLDS])
    storage = GroupRolloutStorage(WORLDS, STEPS, 1, obs[0], 1, "cpu")
    storage.observations.copy_(obs)
    storage.dones[:] = torch.rand(STEPS, WORLDS, 1) < 0.1
    return storage


def test_it_learns_to_tell_the_velocity(make_estimation, storage):
    estimation = make_estimation()
    errors = [estimation.update(storage, FOUR)["Estimator/velocity"] for _ in range(100)]
    assert errors[0] > 1.5  # the variance of a difference of two normal numbers is 2
    assert errors[-1] < 0.1


def test_the_frame_after_an_end_is_not_predicted(make_estimation, storage):
    ended = storage.dones > 0
    target = storage.observations[names.NEXT_PROPRIO]
    target.copy_(torch.where(ended, 1e6, target))
    assert make_estimation().update(storage, ONE)["Estimator/prediction"] < 10.0
    target.copy_(torch.where(ended, target, 1e3))
    assert make_estimation().update(storage, ONE)["Estimator/prediction"] > 1e5


def test_the_prior_starts_standard_normal_and_follows_the_latents(make_estimation, storage):
    estimation = make_estimation()
    skill = torch.eye(SKILLS)
    mean, log_var = estimation.estimator.prior_of(skill)
    assert not mean.any() and not log_var.any()
    estimation.update(storage, FOUR)
    assert estimation.estimator.prior_of(skill)[0].abs().min() > 0


def test_a_withheld_update_changes_nothing(make_estimation, storage):
    estimation = make_estimation("gate_update", floor=0.0)
    extras = {names.NEXT_PROPRIO: torch.zeros(WORLDS, PROPRIO)}
    poor = torch.full((WORLDS,), -1.0)  # no trust at all
    estimation.record(storage, Outcome({}, poor[:, None], poor, torch.ones(WORLDS), extras))
    before = [p.clone() for p in estimation.estimator.parameters()]
    assert estimation.update(storage, FOUR) == {"AdaBoot/trust": 0.0, "AdaBoot/trained": 0.0}
    for old, new in zip(before, estimation.estimator.parameters(), strict=True):
        assert torch.equal(old, new)


def test_an_actor_without_trust_is_told_the_true_velocity(make_estimation, storage):
    estimation = make_estimation("bootstrap_input")
    estimation.adaboot.uses_estimate = torch.arange(WORLDS) % 2 == 0
    obs = storage.observations[0]
    context, estimate = estimation.context(obs), estimation.estimator.context(obs[names.HISTORY])
    assert context.shape == (WORLDS, 3 + LATENT)
    assert torch.equal(context[::2], estimate[::2])
    assert torch.equal(context[1::2, :3], obs[names.VELOCITY][1::2])
    assert torch.equal(context[1::2, 3:], estimate[1::2, 3:])


def test_an_unknown_mode_is_refused(make_estimation):
    with pytest.raises(ConfigError, match="adaboot=on: allowed are gate_update, bootstrap_input"):
        make_estimation("on")
