"""The discriminator: it separates what can be separated, and rewards what looks expert."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from kiras_rl import interfaces as names
from kiras_rl.algorithms.part import Iteration, Outcome
from kiras_rl.algorithms.storage import GroupRolloutStorage
from kiras_rl.config import load_config
from kiras_rl.imitation.self_imitation import SelfImitation
from kiras_rl.models.discriminator import imitation_reward

STEPS, WORLDS = 4, 32
KEYFRAMES = torch.tensor([[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 1.0]])  # two numbers, one-hot


@pytest.fixture
def make_imitation():
    """Return a function that builds a small discriminator taught by keyframes alone."""

    def make(*overrides, noise=0.05, bfloat16=False):
        small = [
            "learner.imitation.discriminator.hidden_dims=[32]",
            "learner.imitation.discriminator.updates=10",
            "learner.imitation.discriminator.batch_size=256",
            "learner.imitation.discriminator.gradient_penalty=0",
            "learner.imitation.premium.keyframe_share=1",
            "learner.imitation.reward_weight=2",
        ]
        config = load_config("base", [*small, *overrides]).learner.imitation
        noise = torch.tensor([noise, noise, 0.0, 0.0])
        code = torch.tensor([False, False, True, True])
        return SelfImitation(config, KEYFRAMES, noise, code, ("a", "b"), WORLDS, STEPS, bfloat16)

    return make


def at(iteration):
    return Iteration(iteration, mini_batches=1, actor_rate=torch.tensor(0.0))


def rollout(imitation, shift, valid=True, velocity=0.3):
    """Hold every world in its keyframe plus `shift`; return the last rewards and the storage."""
    skill = torch.arange(WORLDS) % 2
    features = KEYFRAMES[skill] + torch.tensor([*shift, 0.0, 0.0])
    before = TensorDict(
        {
            names.IMITATION: features,
            names.SKILL: KEYFRAMES[skill][:, 2:],
            names.COMMAND: torch.full((WORLDS, 3), 0.3),
            names.VELOCITY: torch.full((WORLDS, 3), velocity),
        },
        batch_size=[WORLDS],
    )
    storage = GroupRolloutStorage(WORLDS, STEPS, 1, before, 1, "cpu")
    zero = torch.zeros(WORLDS)
    for _ in range(STEPS):
        storage.write(before)
        extras = {
            names.EXTRA_IMITATION: features,
            names.EXTRA_VALID: torch.full((WORLDS,), valid),
            names.EXTRA_TIME_OUTS: zero.bool(),
        }
        imitation.record(storage, Outcome(before, zero[:, None], zero, zero, extras))
        storage.next_row()
    return imitation.rewards()[-1], storage


def test_the_reward_is_one_for_an_expert_and_zero_for_the_policy():
    scores = torch.tensor([-5.0, -1.0, 0.0, 1.0, 2.0, 3.0, 9.0])
    assert imitation_reward(scores).tolist() == [0.0, 0.0, 0.75, 1.0, 0.75, 0.0, 0.0]


@pytest.mark.parametrize("bfloat16", [False, True])
def test_it_tells_a_shifted_motion_from_the_keyframes(make_imitation, bfloat16):
    imitation = make_imitation(bfloat16=bfloat16)
    for iteration in range(60):
        first, storage = rollout(imitation, [0.0, 0.5])
        scalars = imitation.update(storage, at(iteration))
    assert scalars["Discriminator/expert"] > 0.8
    assert scalars["Discriminator/policy"] < -0.8
    assert first.max() < 0.3  # what the policy does earns little,
    near, _ = rollout(imitation, [0.0, 0.0])
    assert near.min() > 1.8  # what it should do nearly all: 2 is the weight


def test_bfloat16_changes_scores_by_its_rounding_alone(make_imitation):
    exact, rounded = (make_imitation(bfloat16=bfloat16).discriminator for bfloat16 in (False, True))
    rounded.load_state_dict(exact.state_dict())
    pairs = torch.randn(500, 2 * KEYFRAMES.shape[1])
    difference = (exact(pairs) - rounded(pairs)).abs()
    assert rounded(pairs).dtype == torch.float32
    assert 0.0 < difference.max() < 0.02  # 8 bits of mantissa, scores of about 1


def test_the_gradient_penalty_keeps_the_slope_low(make_imitation):
    imitation = make_imitation("learner.imitation.discriminator.gradient_penalty=1")
    for iteration in range(40):
        _, storage = rollout(imitation, [0.0, 0.5])
        scalars = imitation.update(storage, at(iteration))
    # A line of slope s in both frames scores +-s/2 half a unit apart, and its squared gradient is
    # 2 s^2: 2 (1 - s/2)^2 + 2 s^2 is least at s = 2/5.
    assert scalars["Discriminator/expert"] == pytest.approx(0.2, abs=0.02)
    assert scalars["Discriminator/policy"] == pytest.approx(-0.2, abs=0.02)


@pytest.mark.parametrize(("velocity", "is_gait"), [(0.3, True), (0.0, False), (-0.3, False)])
def test_premium_motions_go_where_they_are_told(make_imitation, velocity, is_gait):
    imitation = make_imitation(f"learner.imitation.premium.window={STEPS}")
    _, storage = rollout(imitation, [0.0, 0.0], velocity=velocity)
    scalars = imitation.update(storage, at(0))
    assert (scalars["Premium/count_a"] > 0) is is_gait


@pytest.mark.parametrize(
    ("velocity", "share"),
    [(0.3, 1.0), (0.15, 1.0), (0.06, 0.4), (0.0, 0.0), (-0.3, 0.0)],  # 0.3 m/s is commanded
)
def test_a_robot_slower_than_half_of_the_command_earns_in_proportion(
    make_imitation, velocity, share
):
    imitation = make_imitation("learner.imitation.whole_from=[[0,0],[1,0.5]]")
    standing, _ = rollout(imitation, [0.0, 0.0], velocity=velocity)
    imitation.set_progress(1.0)
    late, _ = rollout(imitation, [0.0, 0.0], velocity=velocity)
    assert standing.min() > 0.5  # at first all of it is paid to everybody
    torch.testing.assert_close(late, share * standing)


def test_the_reward_is_logged_by_skill(make_imitation):
    imitation = make_imitation()
    rewards, storage = rollout(imitation, [0.0, 0.5])
    scalars = imitation.update(storage, at(0))
    assert scalars["Imitation/reward_a"] == pytest.approx(rewards[::2].mean().item())
    assert scalars["Imitation/reward_b"] == pytest.approx(rewards[1::2].mean().item())


def test_steps_that_do_not_count_earn_and_teach_nothing(make_imitation):
    imitation = make_imitation()
    for iteration in range(30):
        rewards, storage = rollout(imitation, [0.0, 0.5], valid=False)
        assert not rewards.any()
        imitation.update(storage, at(iteration))
    with torch.no_grad():
        score = imitation.discriminator(storage.observations[names.IMITATION][0].repeat(1, 2))
    assert score.min() > 0.5  # only experts pull, and they pull up


def test_what_has_no_noise_is_smooth_as_well(make_imitation, monkeypatch):
    seen = []

    def spy(discriminator, points, features):
        seen.append(features.tolist())
        return torch.zeros(())

    monkeypatch.setattr("kiras_rl.imitation.self_imitation.gradient_penalty", spy)
    weight = "learner.imitation.discriminator.gradient_penalty=1"
    imitation = make_imitation(weight, noise=0.0)
    _, storage = rollout(imitation, (1.0, 1.0))
    imitation.update(storage, at(0))
    assert seen and all(features == 2 * [True, True, False, False] for features in seen)


def test_the_instance_noise_shrinks_with_progress(make_imitation):
    imitation = make_imitation("learner.imitation.discriminator.noise=[[0,1],[1,0.2]]")
    spreads = []
    for progress in (0.0, 1.0):
        _, storage = rollout(imitation, [0.0, 0.5])
        seen = []
        hook = imitation.discriminator.register_forward_pre_hook(
            lambda _, args, seen=seen: seen.append(args[0].detach())
        )
        imitation.set_progress(progress)
        imitation.update(storage, at(0))
        hook.remove()
        policy = torch.cat([batch[256:] for batch in seen if len(batch) == 512])
        spreads.append(policy[:, 1].std().item())  # 0.5 in every pair
    assert spreads == pytest.approx([0.05, 0.01], rel=0.1)
