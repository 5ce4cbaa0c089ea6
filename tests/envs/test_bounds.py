"""Physics that is finite and still broken: ended, dropped and counted."""

from __future__ import annotations

import pytest
import torch

from kiras_rl.interfaces import EXTRA_VALID


def test_sound_worlds_are_none(build_env):
    env = build_env()
    for _ in range(10):
        log = env.step(torch.randn(8, env.num_actions))[3]["log"]
        assert log["Sim/diverged"] == 0


@pytest.mark.parametrize(
    ("column", "speed"), [(2, 1e4), (3, 1e6), (8, 1e7)], ids=["base", "turn", "joint"]
)
def test_a_world_that_is_too_fast_is_dropped(build_env, column, speed):
    env = build_env("env.randomization.push_velocity=null")
    qvel = env.sim.qvel.clone()
    qvel[1, column] = speed
    env.sim.write_velocity(torch.arange(8) == 1, qvel)
    _, rewards, dones, extras = env.step(torch.zeros(8, env.num_actions))
    assert extras["log"]["Sim/diverged"] >= 1
    assert dones[1]
    assert not extras[EXTRA_VALID][1]
    assert rewards[1] == pytest.approx(-2.0)  # the termination alone
    assert env.sim.qvel[1].abs().max() < 10  # it begins anew


def test_a_world_below_the_ground_is_dropped(build_env):
    env = build_env()
    qpos, qvel = env.sim.qpos.clone(), env.sim.qvel.clone()
    qpos[2, 2] = -3.0
    env.sim.write_state(torch.arange(8) == 2, qpos, qvel, qpos[:, 7:])
    _, _, dones, extras = env.step(torch.zeros(8, env.num_actions))
    assert dones[2]
    assert not extras[EXTRA_VALID][2]
