"""Commands beside velocities and skill: of the library or of a user's file."""

from __future__ import annotations

import pytest
import torch

from kiras_rl import interfaces as names
from kiras_rl.config import ConfigError

MINE = '''
"""Commands of my own, and what looks at them."""

import torch

from kiras_rl.envs.commands import commanding


@commanding(width=1, numbers=1)
def height(asking, limits):
    """Ask for a base height, (N, 1), m, which stays until commands are drawn anew."""
    return torch.where(asking.renewed[:, None], asking.between(limits), asking.before)


@commanding(width=3)
def wide(asking):
    """Return fewer numbers than it says."""
    return asking.before[:, :2]


def unmarked(asking):
    """Say nothing."""
    return asking.before


def seen(view, command: str):
    """Return what a command asks for, (N, k)."""
    return view.task.terms[command]


def paid(step, command: str):
    """Return the first number of a command, (N,)."""
    return step.task.terms[command][:, 0]
'''
WORLDS = 6
CLOCK = "env.commands.terms.clock={frequency: [2.0, 4.0]}"
NEVER = ("env.commands.resample_probability=0", "env.skills.switch_probability=0")


@pytest.fixture(autouse=True)
def mine(tmp_path, monkeypatch):
    """Put a user's file where Python finds it."""
    (tmp_path / "my_commands.py").write_text(MINE)
    monkeypatch.syspath_prepend(tmp_path)


def mine_of(where, name, function, **values):
    pairs = [f"function: 'my_commands:{function}'", *(f"{k}: {v}" for k, v in values.items())]
    return f"env.{where}.{name}={{{', '.join(pairs)}}}"


HEIGHT = mine_of("commands.terms", "low", "height", limits="[0.1, 0.2]")


def test_a_clock_turns_and_keeps_its_frequency(build_env):
    env = build_env(CLOCK, *NEVER, num_envs=WORLDS)
    env.reset()
    before = env.task.terms["clock"]
    assert ((before[:, 1] >= 2.0) & (before[:, 1] < 4.0)).all()
    for _ in range(10):
        _, _, dones, _ = env.step(torch.zeros(WORLDS, 8))
        now = env.task.terms["clock"]
        turned = torch.stack([(before[:, 0] + 0.02 * before[:, 1]) % 1.0, before[:, 1]], dim=1)
        torch.testing.assert_close(now[~dones], turned[~dones])
        before = now


def test_a_clock_goes_on_under_tasks_set_from_outside(build_env):
    env = build_env(CLOCK, num_envs=WORLDS)
    skill, command = torch.zeros(WORLDS, dtype=torch.int64), torch.zeros(WORLDS, 3)
    env.reset(skill, command)
    env.set_task(skill, command)
    before = env.task.terms["clock"]
    env.step(torch.zeros(WORLDS, 8))
    torch.testing.assert_close(
        env.task.terms["clock"][:, 0], (before[:, 0] + 0.02 * before[:, 1]) % 1.0
    )


def test_observations_and_rewards_see_what_is_asked_for(build_env):
    critic = mine_of("observations.critic", "low", "seen", command="low")
    reward = mine_of("rewards.terms", "low", "paid", weight=2.0, command="low")
    env = build_env(HEIGHT, critic, reward, "env.commands.resample_probability=0.5", num_envs=50)
    changed = 0
    for _ in range(5):
        asked = env.task.terms["low"]
        assert ((asked >= 0.1) & (asked < 0.2)).all()
        obs, _, _, extras = env.step(torch.zeros(50, 8))
        torch.testing.assert_close(extras["log"]["Reward/low"], 2.0 * asked.mean())
        assert torch.equal(obs[names.CRITIC][:, -1:], env.task.terms["low"])
        changed += (env.task.terms["low"] != asked).sum()
    assert 75 < changed < 175  # of 250: about every second
    assert (env.keyframe_observations()[..., -1] == 0).all()  # at rest nothing is asked for


def test_a_resumed_environment_asks_for_the_same(build_env):
    overrides = (CLOCK, HEIGHT, "env.commands.resample_probability=0.1")
    first = build_env(*overrides, num_envs=WORLDS)
    second = build_env(*overrides, "seed=9", num_envs=WORLDS)
    for _ in range(5):
        first.step(torch.zeros(WORLDS, 8))
    second.load_state_dict(first.state_dict())
    for _ in range(10):
        for env in (first, second):
            env.step(torch.zeros(WORLDS, 8))
        for name in ("clock", "low"):
            assert torch.equal(first.task.terms[name], second.task.terms[name])


def test_a_recorded_step_asks_for_the_same(build_env):
    """What a graph would read and replace stands in the list of what is carried."""
    env = build_env(CLOCK, num_envs=WORLDS)
    assert "task.terms.clock" in [name for _, name in env._carried()]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("env.commands.terms.clok={frequency: [1, 2]}", "no term 'clok': did you mean 'clock'?"),
        ("env.commands.terms.clock={frequency: 2}", "terms.clock: 2: give [low, high], the lower"),
        ("env.commands.terms.clock={}", "terms.clock: missing a required argument: 'frequency'"),
        (
            mine_of("commands.terms", "x", "wide"),
            "terms.x: the term returns shape (6, 2), it has to",
        ),
        (mine_of("commands.terms", "x", "unmarked"), "'unmarked' does not say how many numbers"),
        (
            mine_of("observations.critic", "x", "seen", command="low"),
            "env.commands.terms: no 'low', configured: none",
        ),
    ],
)
def test_what_cannot_be_a_command_is_one_clear_line(build_env, override, message):
    with pytest.raises(ConfigError) as caught:
        build_env(override, num_envs=WORLDS)
    assert message in str(caught.value) and "\n" not in str(caught.value)
