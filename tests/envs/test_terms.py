"""Terms of users: what has a wrong shape, or no number, is named."""

from __future__ import annotations

import pytest
import torch

from kiras_rl.config import ConfigError, load_config
from kiras_rl.envs import observations, rewards
from kiras_rl.envs.memory import Memory, remembering
from kiras_rl.phases import plan
from kiras_rl.runner import KirasRunner
from kiras_rl.soundness import TrainingError

WORLDS = 4
REWARDS = {
    "column": lambda step: step.robot.base_lin_vel_h[:, 2:3],
    "joints": lambda step: step.robot.joint_torque,
    "number": lambda step: 1.0,
    "fewer": lambda step: step.robot.base_height[:-1],
}


def add(monkeypatch, module, name, function, first):
    """Give a module a term."""
    function.__annotations__ = {function.__code__.co_varnames[0]: first}
    function.__name__ = name
    monkeypatch.setattr(module, name, function, raising=False)


@pytest.mark.parametrize("name", REWARDS)
def test_a_reward_of_a_wrong_shape_is_named_before_the_training(name, build_env, monkeypatch):
    add(monkeypatch, rewards, name, REWARDS[name], "Step")
    with pytest.raises(ConfigError) as caught:
        build_env(f"env.rewards.terms.{name}.weight=1", num_envs=WORLDS)
    message = str(caught.value)
    assert message.startswith(f"env.rewards.terms.{name}: the term returns ")
    assert message.endswith(f"it has to be of shape ({WORLDS})")


def test_a_truth_value_and_double_precision_are_numbers(build_env, monkeypatch):
    add(monkeypatch, rewards, "any_foot", lambda step: step.robot.foot_contact.any(-1), "Step")
    add(monkeypatch, rewards, "double", lambda step: step.robot.base_height.double(), "Step")
    terms = [f"env.rewards.terms.{name}.weight=1" for name in ("any_foot", "double")]
    env = build_env(*terms, num_envs=WORLDS)
    assert env.step(torch.zeros(WORLDS, env.num_actions))[1].dtype == torch.float32


def test_an_observation_of_a_wrong_shape_is_named(build_env, monkeypatch):
    add(monkeypatch, observations, "flat", lambda view: view.robot.base_height, "View")
    with pytest.raises(
        ConfigError, match=r"critic\.flat: the term returns shape \(4\), .*\(4, k\)"
    ):
        build_env("env.observations.critic.flat={}", num_envs=WORLDS)


@pytest.mark.parametrize("where", ["env.rewards.terms", "env.observations.critic"])
def test_a_term_without_a_number_is_named(where, monkeypatch):
    from kiras_rl.envs import make_env

    def broken(value):
        height = value.robot.base_height
        return torch.full_like(height if "rewards" in where else height[:, None], torch.nan)

    module, first = (rewards, "Step") if "rewards" in where else (observations, "View")
    add(monkeypatch, module, "broken", broken, first)
    entry = "{weight: 1}" if "rewards" in where else "{}"
    config = load_config("smoke", ["num_envs=4", "device=cpu", f"{where}.broken={entry}"])
    runner = KirasRunner(make_env(config), plan(config)[0], None, "cpu")
    with pytest.raises(
        TrainingError, match=r"not finite: (Reward/|env\.observations\.critic\.)broken"
    ):
        runner.learn(1)


def test_two_memories_of_one_name_are_refused():
    def air_time(before, step):
        return before

    @remembering(air_time)
    def mine(step):
        return step.memory[air_time][:, 0]

    with pytest.raises(ConfigError, match="two terms remember different things as 'air_time'"):
        Memory([mine, rewards.short_swing], 4, 4, torch.device("cpu"))
