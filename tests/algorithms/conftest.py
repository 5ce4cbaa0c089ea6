"""A learner without a simulator: worlds that only count."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from kiras_rl import interfaces as names
from kiras_rl.config import load_config
from kiras_rl.interfaces import SkillEnv
from kiras_rl.phases import SKILL_LEARNING, phase_of
from kiras_rl.runner import KirasRunner

SMALL = (
    "learner.ppo.num_steps=6",
    "learner.ppo.actor_dims=[16]",
    "learner.ppo.critic_dims=[16]",
    "learner.estimator.encoder_dims=[16]",
    "learner.estimator.decoder_dims=[16]",
    "learner.estimator.latent_dim=2",
    "learner.estimator.adaboot=off",
    "learner.imitation.discriminator.hidden_dims=[16]",
    "learner.imitation.discriminator.batch_size=64",
    "learner.imitation.premium.window=6",
    "iterations=10",
    "finetuning.iterations=10",
)


class CountingEnv(SkillEnv):
    """Episodes of 3 to 6 steps; Phi is (episode, step of the episode, skill)."""

    num_actions, max_episode_length, device, cfg = 2, 6, torch.device("cpu"), {}
    skills, step_dt = ("a", "b"), 0.02
    keyframe_features = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    feature_noise = torch.full((3,), 0.01)
    imitation_terms = (("episode", 1, 1.0), ("step", 1, 1.0), ("skill", 1, 1.0))
    keyframe_height, keyframe_pitch = torch.tensor([0.2, 0.3]), torch.zeros(2)

    def __init__(self, num_envs=16):
        self.num_envs = num_envs
        self.episode = torch.zeros(num_envs)
        self.episode_length_buf = torch.zeros(num_envs, dtype=torch.int64)
        self.skill = torch.arange(num_envs) % 2
        self.falls = torch.arange(num_envs) % 3 == 0
        self.is_flat = torch.zeros(num_envs, dtype=torch.bool)
        self.observe()

    def features(self):
        return torch.stack([self.episode, self.episode_length_buf, self.skill], dim=1).float()

    def observe(self):
        n = self.num_envs
        self.obs = TensorDict(
            {
                names.PROPRIO: torch.randn(n, 4),
                names.HISTORY: torch.randn(n, 8),
                names.CRITIC: torch.randn(n, 5),
                names.IMITATION: self.features(),
                names.VELOCITY: torch.randn(n, 3),
                names.SKILL: torch.nn.functional.one_hot(self.skill, 2).float(),
                names.COMMAND: torch.full((n, 3), 0.4),
            },
            batch_size=[n],
        )
        return self.obs

    def get_observations(self):
        return self.obs

    def step(self, actions):
        self.episode_length_buf += 1
        ends = self.episode_length_buf >= 3 + torch.arange(self.num_envs) % 4
        extras = {
            names.EXTRA_TIME_OUTS: ends & ~self.falls,
            names.EXTRA_IMITATION: self.features(),
            names.EXTRA_VALID: torch.ones(self.num_envs, dtype=torch.bool),
            names.EXTRA_FLAT: self.is_flat,
            names.NEXT_PROPRIO: torch.randn(self.num_envs, 4),
            names.EXTRA_PHYSICS_TIME: 0.0,
            "log": {},
        }
        self.episode += ends
        self.episode_length_buf = torch.where(ends, 0, self.episode_length_buf)
        return self.observe(), 0.5 - actions.square().sum(dim=1), ends, extras

    def keyframe_observations(self):
        return torch.randn(2, 3, 5)

    def set_skill_probabilities(self, probabilities):
        self.probabilities = probabilities

    def unused(self, *args):
        raise NotImplementedError

    seed = reset = place = set_task = measure = foot_pos_b = foot_height_b = unused
    describe = state_dict = load_state_dict = unused


@pytest.fixture
def make_runner():
    """Return a function that builds a small learner of counting worlds, with overrides."""

    def make(*overrides, num_envs=16, phase=SKILL_LEARNING):
        torch.manual_seed(1)
        config = load_config("base", [*SMALL, *overrides])
        return KirasRunner(CountingEnv(num_envs), phase_of(config, phase), None, "cpu")

    return make
