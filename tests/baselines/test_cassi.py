"""Cassi: its rewards by hand, its windows, what it takes from a dataset, and matched labels."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from kiras_rl.algorithms.storage import GroupRolloutStorage
from kiras_rl.baselines.cassi import Windows, disagreement, match, skill_reward
from kiras_rl.config import ConfigError
from kiras_rl.imitation.motions import Motions, load_motions, to_base_frame

PART = "learner.parts.cassi"
FIRST, SECOND = torch.eye(2)


def entropy(*probabilities):
    return -sum(p * math.log(p) for p in probabilities)


def test_a_skill_pays_what_classifiers_know_beyond_guessing():
    probabilities = torch.tensor([[[0.9, 0.1], [0.7, 0.3]]]).expand(2, -1, -1)
    earned = skill_reward(probabilities, torch.stack([FIRST, SECOND]))
    # on average 0.8 for the first of two skills; of the second less than a guess
    assert earned.tolist() == pytest.approx([math.log(0.8) - math.log(0.5), 0.0])
    assert skill_reward(torch.full((1, 5, 4), 0.25), torch.eye(4)[:1]).item() == pytest.approx(0.0)


def test_disagreement_is_what_members_know_and_their_mean_does_not():
    sure = torch.tensor([[[1.0, 0.0], [0.0, 1.0]]])
    assert disagreement(sure).item() == pytest.approx(math.log(2))
    unlike = torch.tensor([[[0.9, 0.1], [0.7, 0.3]]])
    expected = entropy(0.8, 0.2) - (entropy(0.9, 0.1) + entropy(0.7, 0.3)) / 2
    assert disagreement(unlike).item() == pytest.approx(expected, abs=1e-6)
    assert disagreement(unlike[:, :1]).item() == pytest.approx(0.0, abs=1e-6)


def test_labels_are_matched_at_least_cost_over_all():
    # the first would take column 0 for 1, and leave 9 to the second
    cost = np.array([[1.0, 2.0, 9.0], [1.5, 9.0, 9.0], [9.0, 9.0, 3.0]])
    assert match(cost) == (1, 0, 2)


def test_a_window_holds_one_motion_of_one_skill():
    windows = Windows(steps=6, worlds=1, size=3, features=1, device="cpu")
    rollout = GroupRolloutStorage(1, 6, 1, TensorDict({"x": torch.zeros(1, 1)}, [1]), 1, "cpu")
    steps = [  # before, after, skill, valid, ends
        (1.0, 2.0, 0, True, False),
        (2.0, 3.0, 0, True, True),
        (7.0, 8.0, 0, True, False),
        (8.0, 9.0, 1, True, False),  # another skill
        (9.0, 5.0, 1, False, False),  # broken physics
        (5.0, 6.0, 1, True, False),
    ]
    for before, after, skill, valid, ends in steps:
        windows.record(
            rollout,
            torch.tensor([[before]]),
            torch.tensor([[after]]),
            torch.tensor([skill]),
            torch.tensor([valid]),
            torch.tensor([ends]),
        )
        rollout.next_row()
    assert windows.lengths.flatten().tolist() == [2, 3, 2, 2, 1, 2]
    assert windows.windows[1, 0].tolist() == [1.0, 2.0, 3.0]
    assert windows.windows[2, 0, 1:].tolist() == [7.0, 8.0]
    assert windows.windows[3, 0, 1:].tolist() == [8.0, 9.0]


def test_features_are_compared_in_the_spread_of_the_motions():
    motions = Motions(torch.tensor([[0.0, 0.0], [4.0, 0.0]]), torch.tensor([0]))
    std = math.sqrt(8.0) + 0.01
    seen = motions.normalize(torch.tensor([[3.0, 0.005], [1e9, 0.0]]))
    torch.testing.assert_close(seen, torch.tensor([[1.0 / std, 0.5], [10.0, 0.0]]))
    expected = torch.tensor([[-2.0 / std, 0.0, 2.0 / std, 0.0]]).expand(3, -1)
    torch.testing.assert_close(motions.draw_pairs(3), expected)


def test_velocities_turn_with_pitch_and_roll_but_not_with_yaw():
    down = math.radians(30)  # nose down: gravity also points ahead
    pitched = np.array([[math.sin(down), 0.0, -math.cos(down)]])
    turned = to_base_frame(np.array([[1.0, 0.5, 0.0]]), pitched)
    np.testing.assert_allclose(turned, [[math.cos(down), 0.5, math.sin(down)]], atol=1e-9)
    rolled = np.array([[0.0, -math.sin(down), -math.cos(down)]])
    turned = to_base_frame(np.array([[1.0, 0.0, 1.0]]), rolled)
    np.testing.assert_allclose(turned, [[1.0, math.sin(down), math.cos(down)]], atol=1e-9)


def test_the_shipped_motions_are_features_of_the_environment(build_env):
    env = build_env(cfg="baselines/cassi", num_envs=2)
    motions = load_motions("solo8", env, "cpu")
    # velocities, gravity, angles and height: 26 numbers, as published, and no code of a skill
    assert motions.frames.shape[1] == sum(size for _, size, _ in env.imitation_terms) == 26
    keyframes = motions.normalize(env.keyframe_features)
    assert keyframes.abs().max() < 3.0  # standard deviations: the motions are near all of them


@pytest.mark.parametrize(
    ("override", "part"),
    [
        (f"{PART}.dataset=nowhere", "dataset=nowhere: no dataset at nowhere"),
        (f"{PART}.members=0", f"{PART}.members=0: allowed are 1 to 100"),
        ("robot=go1", "it is of solo8 at 50 Hz, not of go1 at 50 Hz"),
        (
            "env.observations.imitation.foot_height={}",
            "no motion has env.observations",
        ),
    ],
)
def test_a_mistake_is_one_line(make_runner, override, part):
    with pytest.raises(ConfigError) as caught:
        make_runner("cassi", "run", override)
    assert part in str(caught.value)
    assert "\n" not in str(caught.value)


def test_classes_weigh_the_same_however_rare(make_runner):
    shape = ("num_envs=10", f"{PART}.batch_size=4096")
    cassi = make_runner("cassi", "run", *shape).alg.parts["cassi"]
    cassi.motion.lengths[:] = 8
    cassi.motion.lengths[:, 9] = 7  # not whole
    cassi._skill[:] = torch.eye(5)[torch.tensor([0, 0, 0, 0, 0, 1, 2, 3, 4, 4])]
    (batch,) = cassi._skill_batches()
    weights = (batch["weight"][..., None] * batch["skill"]).sum(dim=(0, 1))
    # a fifth each of all rows that are drawn, within 5 standard deviations of the rarest
    drawn = batch["weight"].numel()
    bound = 5 * 2.0 * math.sqrt(0.1 * 0.9 / drawn)
    assert (weights / drawn).tolist() == pytest.approx([0.2] * 5, abs=bound)


def test_a_run_does_not_go_on_with_other_motions(make_runner):
    cassi = make_runner("cassi", "run").alg.parts["cassi"]
    state = cassi.state_dict()
    state["experts"] = state["experts"] + 0.01
    with pytest.raises(ConfigError, match="dataset=solo8: not the motions that"):
        cassi.load_state_dict(state)


def test_windows_go_on_where_a_rollout_ends(make_runner):
    runner = make_runner("cassi", "run", "env.terminations.episode_length=20")
    runner.learn(1)
    motion = runner.alg.parts["cassi"].motion
    before = motion.windows[-1].clone(), motion.lengths[-1].clone()
    runner.learn(1)
    going = (before[1] == 8) & (motion.lengths[0] == 8)
    assert going.any()
    features = before[0].shape[1] // 8
    # all but the oldest frame, and the one that the next step began with: a push may lie between
    torch.testing.assert_close(
        motion.windows[0][going, : 6 * features], before[0][going, features : 7 * features]
    )


def test_rewards_are_style_skill_and_disagreement(make_runner, monkeypatch):
    cassi = make_runner("cassi", "run", "num_envs=3").alg.parts["cassi"]
    lengths = torch.tensor([1, 2, 8])
    cassi.motion.lengths[:] = lengths
    cassi._skill[..., 0] = 1.0
    monkeypatch.setattr(cassi, "discriminator", lambda pairs: torch.full((len(pairs),), 0.0))
    logits = torch.zeros(5)
    logits[0] = math.log(6.0)  # of five skills 6 / 10 for the first
    monkeypatch.setattr(cassi, "ensemble", lambda rows: logits.expand(len(rows), 5, 5))
    earned = cassi.rewards()[0]
    style, skill = 1 - 0.25, math.log(0.6) - math.log(0.2)
    assert earned.tolist() == pytest.approx([0.0, style, style + skill], abs=1e-5)
