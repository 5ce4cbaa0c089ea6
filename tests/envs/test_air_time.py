"""Time in the air, as the reward of it sees it, against counting contacts step by step."""

from __future__ import annotations

import torch

from kiras_rl.config import load_config

TARGET = 0.1
ALONE = [
    *(f"env.rewards.terms.{name}=null" for name in load_config("solo8").env.rewards.terms),
    f"env.rewards.terms.feet_air_time={{weight: 1.0, target: {TARGET}}}",
    "env.commands.zero_probability=0",
    "env.commands.lin_vel_x=[0.2,0.6]",  # nobody is asked to stand
    "env.terminations.episode_length=0.5",
]


def test_feet_are_paid_for_the_time_since_they_last_stood(build_env):
    env = build_env(*ALONE, num_envs=8)
    in_air = torch.zeros(8, 4)
    earned = ended = 0
    for _ in range(60):
        _, rewards, done, _ = env.step(1.5 * torch.randn(8, env.num_actions))
        contact = env.measure().foot_stands
        landing = contact & (in_air > 0)
        torch.testing.assert_close(rewards, ((in_air - TARGET) * landing).sum(1))
        in_air = torch.where(contact | done[:, None], 0.0, in_air + env.step_dt)
        earned, ended = earned + landing.sum(), ended + done.sum()
    assert earned > 20 and ended > 8
