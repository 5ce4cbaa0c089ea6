"""Constraints: measured violations that parts of a learner find in what a step returns."""

from __future__ import annotations

import pytest
import torch

from kiras_rl import interfaces as names
from kiras_rl.config import ConfigError

WORLDS = 4
MINE = '''
def low(step, height: float):
    """Return how far the base is below `height` m, m; negative above it."""
    return height - step.robot.base_height
'''


@pytest.fixture(autouse=True)
def mine(tmp_path, monkeypatch):
    """Put a user's file where Python finds it."""
    (tmp_path / "my_constraints.py").write_text(MINE)
    monkeypatch.syspath_prepend(tmp_path)


def test_violations_are_what_is_beyond_and_never_negative(build_env):
    env = build_env(
        "env.constraints.joint_speed={most: 2.0}",
        "env.constraints.joint_torque={share: 0.5}",
        "env.constraints.foot_force={most: 0.4}",
        "env.constraints.low={function: 'my_constraints:low', height: 0.2}",
        num_envs=WORLDS,
    )
    assert env.constraints == ("joint_speed", "joint_torque", "foot_force", "low")
    met = torch.zeros(4, dtype=torch.bool)
    for _ in range(10):
        found = env.step(3 * torch.randn(WORLDS, 8))[3][names.EXTRA_CONSTRAINTS]
        seen = env.measure()
        expected = [
            seen.joint_vel.abs().amax(1) - 2.0,
            (seen.peak_torque / env.torque_limit).amax(1) - 0.5,
            env.robot.foot_force.amax(1) / (9.81 * env.mass) - 0.4,
            0.2 - seen.base_height,
        ]
        torch.testing.assert_close(found, torch.stack(expected, dim=1).clamp(min=0.0))
        met |= (found > 0).any(0)
    assert met.all()


def test_a_world_whose_physics_broke_violates_nothing(build_env):
    env = build_env("env.constraints.joint_speed={most: 0.0}", num_envs=WORLDS)
    broken = torch.arange(WORLDS) == 1
    env.sim.write_velocity(broken, torch.full_like(env.sim.qvel, torch.nan))
    found = env.step(torch.randn(WORLDS, 8))[3][names.EXTRA_CONSTRAINTS]
    assert found[1] == 0 and (found[~broken] > 0).all()


def test_without_constraints_nothing_is_measured(build_env):
    env = build_env(num_envs=WORLDS)
    assert env.constraints == ()
    assert names.EXTRA_CONSTRAINTS not in env.step(torch.zeros(WORLDS, 8))[3]


def test_a_constraint_that_cannot_be_is_one_clear_line(build_env):
    with pytest.raises(ConfigError, match=r"no term 'joint_sped': did you mean 'joint_speed'\?"):
        build_env("env.constraints.joint_sped={most: 2.0}", num_envs=WORLDS)


def test_those_of_the_gait_see_landings_and_who_is_told_to_stand(build_env):
    env = build_env(
        "env.constraints.joint_acceleration={most: 5.0}",
        "env.constraints.action_rate={most: 10.0}",
        "env.constraints.limb_contact={force: 0.5}",
        "env.constraints.short_swing={least: 0.25}",
        "env.constraints.idle_speed={most: 0.5}",
        "env.constraints.standing_feet={feet: 2}",
        num_envs=WORLDS,
    )
    command = torch.tensor([[0.0] * 3] * 2 + [[0.5, 0.0, 0.0]] * 2)
    env.reset(torch.arange(WORLDS), command)
    moving, dt = command[:, 0] > 0, env.step_dt
    flown, met = torch.zeros(WORLDS, 4), torch.zeros(6, dtype=torch.bool)
    for _ in range(25):
        velocity, before = env.sim.qvel[:, 6:].clone(), env._action.clone()
        actions = 2 * torch.randn(WORLDS, 8)
        _, _, dones, extras = env.step(actions)
        seen, stands = env.measure(), env.measure().foot_stands
        swings = torch.where(stands & (flown > 0), 0.25 - flown, 0.0).clamp(min=0.0)
        clip = env.cfg.action_clip
        expected = [
            (seen.joint_vel - velocity).abs().amax(1) / dt - 5.0,
            (actions.clamp(-clip, clip) - before).abs().amax(1) / dt - 10.0,
            (env.robot.limb_force > 0.5).any(1).float(),
            swings.amax(1) * moving,
            (seen.joint_vel.abs().amax(1) - 0.5) * ~moving,
            (stands.sum(1) - 2).abs() * moving,
        ]
        found = extras[names.EXTRA_CONSTRAINTS]
        torch.testing.assert_close(found, torch.stack(expected, dim=1).clamp(min=0.0))
        met |= (found > 0).any(0)
        flown = (flown + dt) * ~stands * ~dones[:, None]
    assert met.all()
