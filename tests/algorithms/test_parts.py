"""A part of a user's own: one class, named in the YAML, that every stage of learning asks."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from kiras_rl.algorithms.kiras import KirasPPO
from kiras_rl.algorithms.part import Part
from kiras_rl.config import ConfigError

WEIGHT = 0.25


class Taught(Part):
    """Ends every episode to a quarter, pays for actions near zero, and teaches action 0.3."""

    reward_group = "calm"
    learns_from = ("lesson",)

    def __init__(self, lesson, env):
        """Take the action that is taught."""
        self.lesson, self.env, self.progress = lesson, env, []
        self.network = nn.Linear(1, 1)

    @classmethod
    def build(cls, config, setting):
        """Take what the YAML says."""
        return cls(config["lesson"], setting.env)

    def groups(self, obs):
        """Store a lesson for each action."""
        return {"lesson": torch.zeros(len(obs), self.env.num_actions)}

    def record(self, rollout, step):
        """Make ends soft."""
        step.dones = step.dones + WEIGHT * (1 - step.dones.float())
        self.step = rollout.step
        return {"lesson": torch.full_like(step.actions, self.lesson)}

    def rewards(self):
        """Pay a number that is easy to find again."""
        return torch.full((self.step, self.env.num_envs), 7.0)

    def policy_loss(self, mean, batch):
        """Pull to the lesson."""
        return 10.0 * (mean - batch["lesson"]).square().mean()

    def update(self, rollout, iteration):
        """Change the network, so that a checkpoint can be told from another."""
        with torch.no_grad():
            self.network.weight += 1.0
        return {"Taught/iteration": float(iteration.number)}

    def networks(self):
        """Return the network."""
        return {"taught": self.network}

    lasting = networks

    def state_dict(self):
        """Return the network."""
        return self.network.state_dict()

    def load_state_dict(self, state):
        """Load the network."""
        self.network.load_state_dict(state)


class Patient(KirasPPO):
    """An algorithm of a user's own."""


def taught(lesson=0.3, class_name=f"{__name__}:Taught"):
    return f"learner.parts.taught={{class_name: '{class_name}', lesson: {lesson}}}"


def test_it_sees_and_changes_every_stage(make_runner):
    runner, seen = make_runner(taught()), []
    alg = runner.alg
    assert len(alg.critic.critics) == 3  # task, imitation, calm
    obs = runner.env.get_observations()
    before = (alg.act_deterministic(obs) - 0.3).abs().mean()
    runner.learn(3, on_iteration=lambda status: seen.append(status.scalars))
    assert [scalars["Taught/iteration"] for scalars in seen] == [0.0, 1.0, 2.0]
    assert seen[0]["Critic/calm_reward"] >= 7.0  # and what an end by the clock adds
    assert alg.storage.dones.min() == WEIGHT
    assert (alg.act_deterministic(obs) - 0.3).abs().mean() < 0.5 * before


def test_it_is_saved_and_goes_on_into_the_next_phase(make_runner):
    one, other = make_runner(taught()), make_runner(taught())
    one.learn(2)
    weight = one.alg.parts["taught"].network.weight
    other.alg.load(one.alg.save())
    assert torch.equal(other.alg.parts["taught"].network.weight, weight)
    assert torch.equal(one.alg.networks()["taught"]["weight"], weight)


def test_null_leaves_it_out(make_runner):
    assert "taught" not in make_runner(taught(), "learner.parts.taught=null").alg.parts


def test_what_a_part_does_not_take_is_refused(make_runner):
    unknown = f"learner.parts.taught={{class_name: '{__name__}:Taught', lessen: 0.3}}"
    with pytest.raises(ConfigError, match=r"learner\.parts\.taught=.*Taught does not take this"):
        make_runner(unknown)


@pytest.mark.parametrize("name", ["foo", "torch.nn:Linear", "rsl_rl.algorithms:PPO"])
def test_an_algorithm_of_another_kind_is_refused(make_runner, name):
    with pytest.raises(ConfigError, match=r"learner\.class_name="):
        make_runner(f"learner.class_name={name}")


def test_a_subclass_of_the_algorithm_is_used(make_runner):
    runner = make_runner(f"learner.class_name={__name__}:Patient")
    assert type(runner.alg) is Patient


@pytest.mark.parametrize("name", ["nowhere.at_all:Part", "torch:nn", "torch.nn:Linear", "Taught"])
def test_a_class_that_is_no_part_is_refused(make_runner, name):
    with pytest.raises(ConfigError, match=r"learner\.parts\.taught\.class_name="):
        make_runner(taught(class_name=name))
