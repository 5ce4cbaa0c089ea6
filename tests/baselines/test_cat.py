"""CaT: its probabilities by hand, what becomes of rewards and ends, and what its block may say."""

from __future__ import annotations

import pytest
import torch

from kiras_rl import interfaces as names
from kiras_rl.algorithms.part import Outcome
from kiras_rl.algorithms.returns import generalized_advantages
from kiras_rl.baselines.cat import termination, update_maxima
from kiras_rl.config import ConfigError

PART = "learner.parts.cat"
CONSTRAINTS = (
    *("joint_torque", "joint_speed", "joint_acceleration", "action_rate", "foot_force"),
    *("limb_contact", "short_swing", "idle_speed", "standing_feet"),
)


@pytest.fixture
def part(make_runner):
    """Return the part of a small training of four worlds."""
    return make_runner("cat", "run", "num_envs=4").alg.parts["cat"]


def outcome(violations, flat=True, rewards=1.0, ended=False, time_out=False):
    """Return a step of four worlds; what is given once holds for all of them."""
    given = (flat, rewards, ended, time_out)
    flat, rewards, ended, time_out = (torch.as_tensor(x).expand(4).clone() for x in given)
    extras = {
        names.EXTRA_CONSTRAINTS: violations,
        names.EXTRA_FLAT: flat,
        names.EXTRA_TIME_OUTS: time_out,
    }
    return Outcome({}, torch.zeros(4, 8), rewards.float(), ended, extras)


def violating(**values):
    """Return violations, (4, C): one number a world of each constraint that is named."""
    found = torch.zeros(4, len(CONSTRAINTS))
    for name, numbers in values.items():
        found[:, CONSTRAINTS.index(name)] = torch.tensor(numbers)
    return found


def test_a_violation_ends_by_its_share_of_the_maximum():
    violations = torch.tensor([[1.0, 0.0], [4.0, 0.0], [1.0, 3.0], [0.0, 0.0]])
    delta = termination(violations, torch.tensor([2.0, 6.0]), torch.tensor([0.1, 1.0]))
    # 1 of 2 at p = 0.1; beyond the maximum; max(0.05, 3 of 6 at p = 1); none
    assert delta.tolist() == pytest.approx([0.05, 0.1, 0.5, 0.0])


def test_maxima_begin_at_the_first_and_follow_slowly():
    violations = torch.tensor([[1.0, 0.0], [4.0, 0.0]])
    first = update_maxima(torch.zeros(2), violations, 0.95)
    assert first.tolist() == pytest.approx([4.0, 1e-6])
    then = update_maxima(first, torch.tensor([[0.0, 2.0], [1.0, 1.0]]), 0.95)
    assert then.tolist() == pytest.approx([0.95 * 4.0 + 0.05 * 1.0, 0.95e-6 + 0.05 * 2.0])


def test_what_comes_after_counts_by_what_is_left():
    rewards, values = torch.tensor([1.0, 2.0]), torch.tensor([0.5, 1.0])
    ends = torch.tensor([0.25, 0.5])
    advantages = generalized_advantages(
        rewards.view(2, 1, 1), values.view(2, 1, 1), torch.tensor([[8.0]]), ends.view(2, 1, 1),
        gamma=0.5, lam=0.5,
    )  # fmt: skip
    # last: 2 + .5 * .5 * 8 - 1 = 3; first: 1 + .75 * .5 * 1 - .5 + .75 * .5 * .5 * 3 = 1.4375
    assert advantages.flatten().tolist() == [1.4375, 3.0]


def test_rewards_are_scaled_and_never_negative(part):
    part.maxima[:] = 4.0
    part.config.decay = 1.0
    step = outcome(
        violating(joint_torque=[0.0, 2.0, 4.0, 4.0], foot_force=[0.0, 0.0, 1.0, 4.0]),
        rewards=[2.0, 2.0, 2.0, -2.0],
    )
    part.record(None, step)
    # soft at p = 1 / 20, hard at p = 1
    assert step.dones.tolist() == pytest.approx([0.0, 0.025, 0.25, 1.0])
    assert step.rewards.tolist() == pytest.approx([2.0, 1.95, 1.5, 0.0])


def test_a_fall_ends_for_certain_and_the_clock_costs_nothing(part):
    part.maxima[:] = 4.0
    step = outcome(
        violating(joint_torque=[0.0, 0.0, 4.0, 0.0]),
        ended=[False, True, True, True],
        time_out=[False, False, True, True],
    )
    part.record(None, step)
    assert step.dones.tolist() == [0.0, 1.0, 1.0, 1.0]
    assert step.rewards.tolist() == pytest.approx([1.0, 0.0, 0.95, 1.0])


def test_style_holds_on_flat_ground_alone(part):
    part.maxima[:] = 1.0
    violations = violating(short_swing=[1.0, 1.0, 0.0, 0.0], joint_speed=[0.0, 0.0, 1.0, 1.0])
    step = outcome(violations, flat=[True, False, True, False])
    part.record(None, step)
    assert step.dones.tolist() == pytest.approx([0.05, 0.0, 0.05, 0.05])


def test_soft_constraints_grow_as_one_over_the_steps(part):
    soft, hard, idle = (CONSTRAINTS.index(n) for n in ("action_rate", "foot_force", "idle_speed"))
    for progress, expected in ((0.0, 1 / 20), (0.25, 1 / 12), (0.5, 1 / 4), (1.0, 1 / 4)):
        part.set_progress(progress)
        assert part.probability[soft].item() == pytest.approx(expected)
        assert part.probability[[hard, idle]].tolist() == pytest.approx([1.0, 0.1])


def test_violations_of_a_training_arrive(make_runner):
    runner, seen = make_runner("cat", "run"), []
    runner.learn(1, on_iteration=lambda status: seen.append(status.scalars))
    dones = runner.alg.storage.dones
    assert ((dones > 0.0) & (dones < 1.0)).any()
    assert 0.0 < seen[0]["CaT/termination"] <= dones.mean().item() + 1e-6
    for name in runner.env.constraints:
        assert 0.0 <= seen[0][f"CaT/violated_{name}"] <= 1.0
    assert runner.alg.storage.task_rewards.min() >= 0.0


@pytest.mark.parametrize(
    ("override", "part"),
    [
        (f"{PART}.decay=1.5", f"{PART}.decay=1.5: allowed are 0 to 1"),
        (f"{PART}.fixed.foot_farce=1", "fixed: no 'foot_farce' in env.constraints, configured: "),
        (f"{PART}.fixed.foot_force=2", "fixed.foot_force=2.0: allowed are 0 to 1"),
        (f"{PART}.flat_only=[air]", "flat_only: no 'air' in env.constraints"),
        (f"{PART}.soft=[[0.5,4],[0,20]]", "give [share of the phase, steps], in their order"),
        (f"{PART}.soft=[]", "give [share of the phase, steps], in their order"),
        (f"{PART}.soft=[[0,0.5]]", "steps are 1 / p, at least 1"),
    ],
)
def test_a_mistake_is_one_line(make_runner, override, part):
    with pytest.raises(ConfigError) as caught:
        make_runner("cat", "run", override)
    assert part in str(caught.value)
    assert "\n" not in str(caught.value)


def test_without_constraints_there_is_nothing_to_do(make_runner):
    nothing = [f"env.constraints.{name}=null" for name in CONSTRAINTS]
    with pytest.raises(ConfigError, match=r"env\.constraints: none"):
        make_runner("cat", "run", *nothing)
