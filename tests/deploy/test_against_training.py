"""The robot sees what training saw: the environment's observations, rebuilt from readings."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from kiras_rl import __version__
from kiras_rl.config import load_config
from kiras_rl.deploy.metadata import FORMAT, PolicyMetadata
from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.envs import make_env
from kiras_rl.export import export_policy

STEPS = 80


@pytest.fixture(scope="module")
def env():
    """Two worlds without noise, in short episodes; tasks and resets as in training."""
    overrides = ["sim.threads=1", "env.terminations.episode_length=0.5"]
    return make_env(load_config("solo8_quick", overrides), "cpu", num_envs=2)


def test_frames_actions_and_targets_are_those_of_training(env, make_policy, tmp_path, monkeypatch):
    sent, step = [], env.sim.step
    monkeypatch.setattr(env.sim, "step", lambda ctrl: sent.append(ctrl[0].numpy()) or step(ctrl))
    header = {"format": FORMAT, "version": __version__, "provenance": {}}
    metadata = PolicyMetadata.from_dict(header | env.describe())
    policy = make_policy(metadata, gain=1.0)
    export_policy(policy, metadata, tmp_path / "a.onnx")
    onboard = OnboardPolicy(tmp_path / "a.onnx")
    begun, starts = True, 0
    obs = env.get_observations()
    for _ in range(STEPS):
        qpos, qvel = env.sim.qpos[0].numpy(), env.sim.qvel[0].numpy()
        if begun:
            onboard.reset(qpos[7:])  # a reset aims at the joint angles that it draws
            starts += 1
        command, skill = obs["command"][0].numpy(), obs["skill"][0].argmax().item()
        target = onboard.step(qpos[7:], qvel[6:], qpos[3:7], qvel[3:6], command, skill)
        with torch.no_grad():
            actions = policy(obs["proprio"], obs["history"])[0]
        np.testing.assert_allclose(onboard.frame, obs["proprio"][0], atol=1e-4)
        np.testing.assert_allclose(onboard.history.ravel(), obs["history"][0], atol=1e-4)
        np.testing.assert_allclose(onboard.action, actions[0].clamp(-6, 6), atol=1e-3)
        obs, _, done, _ = env.step(actions)
        np.testing.assert_allclose(target, sent[-1], atol=1e-3)
        begun = bool(done[0])
    assert starts > 2  # histories began anew
    low, high = np.array(metadata.joint_limits).T
    at_limit = [np.isclose(t, low, atol=1e-5) | np.isclose(t, high, atol=1e-5) for t in sent]
    assert np.mean(at_limit) > 0.01  # some targets were beyond the limits
    assert all((t >= low - 1e-5).all() and (t <= high + 1e-5).all() for t in sent)
