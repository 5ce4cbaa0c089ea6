"""DreamWaQ: its loss by hand, what its encoder reads, and whom the actor believes."""

from __future__ import annotations

import math

import pytest
import torch

from kiras_rl import interfaces as names
from kiras_rl.algorithms.adaboot import trust
from kiras_rl.baselines.dreamwaq import CENet
from kiras_rl.config import ConfigError

PART = "learner.parts.cenet"


@pytest.fixture
def cenet():
    """A network without hidden layers on two frames of one number, with latents of one number.

    It says velocity (1, 0, 0) m/s, and of z mean 2 and variance e; it decodes 3 v_x + 5 z + 7.
    """
    network = CENet(proprio_dim=1, history_length=1, latent_dim=1, encoder_dims=[], decoder_dims=[])
    with torch.no_grad():
        (encoder,), (decoder,) = network.encoder, network.decoder
        encoder.weight.zero_()
        encoder.bias.copy_(torch.tensor([1.0, 0.0, 0.0, 2.0, 1.0]))
        decoder.weight.copy_(torch.tensor([[3.0, 0.0, 0.0, 5.0]]))
        decoder.bias.fill_(7.0)
    return network


@pytest.fixture
def part(make_runner):
    """The part of a small training, with the environment's first observation."""
    runner = make_runner("dreamwaq", "run")
    return runner.alg.parts["cenet"], runner.env.get_observations()


def test_its_loss_is_that_of_a_beta_vae(cenet, part):
    estimation, _ = part
    estimation.estimator = cenet
    errors = estimation._losses(
        frames=torch.zeros(1, 2),
        velocity=torch.tensor([[0.0, 0.0, 3.0]]),
        target=torch.tensor([[20.0]]),
        skill=torch.zeros(1, 5),
        noise=torch.tensor([[0.5]]),
        target_weight=torch.ones(1),
    )
    z = 2.0 + 0.5 * math.exp(0.5)
    kl = 0.5 * (math.e + 2.0**2 - 1.0 - 1.0)  # of N(2, e) from N(0, 1)
    expected = [(1.0 + 9.0) / 3, (3.0 + 5.0 * z + 7.0 - 20.0) ** 2, kl, 0.0]
    assert [error.item() for error in errors] == pytest.approx(expected, rel=1e-5)


def test_the_encoder_reads_the_current_frame_last():
    network = CENet(proprio_dim=2, history_length=2, latent_dim=1, encoder_dims=[], decoder_dims=[])
    obs = {names.PROPRIO: torch.tensor([[5.0, 6.0]]), names.HISTORY: torch.arange(1.0, 5.0)[None]}
    assert network.frames(obs).tolist() == [[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]]


def test_the_robot_gets_what_the_actor_was_trained_with(part, make_runner):
    estimation, obs = part
    estimation.adaboot.uses_estimate[:] = True
    runner = make_runner("dreamwaq", "other")
    runner.alg.parts["cenet"].estimator.load_state_dict(estimation.estimator.state_dict())
    seen = torch.cat([obs[names.PROPRIO], estimation.context(obs)], dim=-1)
    expected = runner.alg.actor.mlp(seen)
    torch.testing.assert_close(runner.alg.act_deterministic(obs), expected)


def test_the_actor_is_told_the_truth_until_returns_are_alike(part):
    estimation, obs = part
    adaboot = estimation.adaboot
    assert adaboot.bootstraps_input
    assert not adaboot.gates_update
    context = estimation.context(obs)
    assert torch.equal(context[:, :3], obs[names.VELOCITY])
    adaboot._last = torch.linspace(1.0, 2.0, 16)
    adaboot.renew()
    # R evenly from 1 to 2: mean 1.5, and the standard deviation of 16 such numbers
    cv = (math.sqrt(16 * 17 / 12) / 15) / 1.5
    assert adaboot.probability.item() == pytest.approx(1 - math.tanh(cv), rel=1e-5)
    assert adaboot.probability == trust(adaboot._last)


@pytest.mark.parametrize(
    ("override", "part"),
    [
        (f"{PART}.kl_wait=1", f"unknown key '{PART}.kl_wait'; did you mean '{PART}.kl_weight'?"),
        (f"{PART}.latent_dim=many", f"{PART}: latent_dim: Value 'many' of type 'str'"),
        (f"{PART}.kl_weight=-1", f"{PART}.kl_weight=-1.0: must not be negative"),
        (f"{PART}.encoder_dims=[8,0]", f"{PART}.encoder_dims=[8, 0]: must be positive"),
        (f"{PART}={{class_name: kiras_rl.baselines.dreamwaq:CENet}}", "it has to be a kiras_rl"),
    ],
)
def test_a_mistake_in_its_block_is_one_line(make_runner, override, part):
    with pytest.raises(ConfigError) as caught:
        make_runner("dreamwaq", "run", override)
    assert part in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_block_that_is_not_whole_is_refused(make_runner):
    lacking = (f"{PART}.kl_weight=null",)
    with pytest.raises(ConfigError, match="kl_weight"):
        make_runner("dreamwaq", "run", *lacking)
