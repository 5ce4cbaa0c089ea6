"""The environment on terrain: what is seen and judged is relative to the ground below."""

from __future__ import annotations

import math

import pytest
import torch

from kiras_rl.config import load_config
from kiras_rl.envs import make_env
from kiras_rl.envs.terrains import CROSSED
from kiras_rl.evaluation.terrain import Trials, evaluate_terrain, run_trials
from kiras_rl.phases import FINETUNING, phase_of

CALM = (
    "num_envs=8",
    "sim.backend=native",
    "env.observations.noise=false",
    "env.skills.joint_noise=0",
    "env.skills.velocity_noise=0",
    "env.randomization.push_velocity=null",
    "env.randomization.action_delay=null",
    "finetuning.env.terrain.levels=2",
    "finetuning.env.terrain.variants=2",
)


@pytest.fixture(scope="module")
def build():
    """Return a function that builds an environment as finetuning has it, with overrides."""

    def make(*overrides):
        config = load_config("solo8", [*CALM, *overrides])
        return make_env(phase_of(config, FINETUNING).config)

    return make


@pytest.fixture
def env(build):
    return build()


def place(env, name, level=1):
    """Put every world on one terrain, walking in its first skill, and begin."""
    index = torch.full((env.num_envs,), env.terrains.index(name))
    env.place(index, torch.full_like(index, level))
    return env.reset(torch.zeros_like(index), torch.zeros(env.num_envs, 3))


def holding(env):
    """Return the actions that hold the start pose."""
    return env._action.clone()


@pytest.mark.parametrize(
    "name",
    [
        "flat",
        "slopes",
        "bars",
        "footholds",
        "stairs_up",
        "stairs_down",
        "pits",
        "plates",
        "ramps",
        "rough",
    ],
)
def test_robots_stand_on_their_platform_in_their_keyframe(env, name):
    place(env, name)
    action = holding(env)
    for _ in range(25):
        env.step(action)
    now = env.measure()
    assert not now.fallen.any()
    assert now.foot_contact.all()
    assert now.base_height == pytest.approx(env.keyframe_height[0].item(), abs=0.04)  # it sags
    assert env.robot.foot_height.abs().max() < 0.003


def test_rough_ground_has_tasks_of_its_own(build):
    env = build("num_envs=600")
    flat = env._curriculum.is_flat
    env.reset()
    command, heading = env.task.command, env.task.heading
    moving = command[:, 0] != 0
    ahead = command[~flat & moving, 0]
    assert ahead.min() >= 0.25 and ahead.max() <= 0.6
    assert not heading[~flat & moving].isnan().any()
    assert command[flat, 0].min() < -0.2 and heading[flat].isnan().all()
    assert (~moving[~flat]).float().mean().item() == pytest.approx(0.03, abs=0.03)


def test_headings_are_drawn_all_round(build):
    env = build("num_envs=64")
    place(env, "flat")
    turns = torch.bincount(((env.robot.yaw + math.pi) / (math.pi / 2)).long(), minlength=4)
    assert turns.min() > 5


def put(env, x):
    """Put every base `x` m ahead of the middle of its tile, looking along x."""
    qpos, qvel = env.sim.qpos.clone(), env.sim.qvel.clone()
    qpos[:, :2] = torch.tensor([x, 0.0])
    qpos[:, 3:7] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    env.sim.write_state(torch.ones(env.num_envs, dtype=torch.bool), qpos, qvel, qpos[:, 7:])
    env.robot.read_kinematics()


@pytest.mark.parametrize(("name", "sign"), [("stairs_up", -1), ("stairs_down", 1)])
def test_the_scan_sees_the_step_ahead(env, name, sign):
    """Beyond the platform, 0.6 m from the middle, the ground is one riser higher or lower."""
    place(env, name)
    put(env, 0.3)
    scan = env.robot.height_scan().view(8, 9, 7)
    change = scan[:, -1] - scan[:, 4]  # 0.4 m ahead of the base, and under it
    assert change.mean() == pytest.approx(sign * 0.12, abs=0.04)  # the rest is bumps


def test_a_step_ahead_of_a_foot_has_to_be_cleared(build):
    env = build("finetuning.env.terrain.noise=[0,0]")
    place(env, "stairs_up")
    feet = env.foot_pos_b(env.robot.joint_pos)[0, :, 0]
    put(env, 0.6 - 0.08 - feet.max().item())  # front feet 8 cm before the step of 12 cm
    over_ground, over_step = env.robot.foot_height, env.robot.foot_clearance
    front = feet > 0
    torch.testing.assert_close(over_step[:, ~front], over_ground[:, ~front])
    torch.testing.assert_close(over_step[:, front], over_ground[:, front] - 0.12)
    place(env, "stairs_down")
    put(env, 0.6 - 0.08 - feet.max().item())
    torch.testing.assert_close(env.robot.foot_clearance, env.robot.foot_height)


def test_the_ground_falls_beside_a_foot_on_an_edge(build):
    env = build("finetuning.env.terrain.noise=[0,0]")
    place(env, "stairs_down")
    feet = env.foot_pos_b(env.robot.joint_pos)[0, :, 0]
    front = feet > 0
    put(env, 0.6 - 0.02 - feet.max().item())  # front feet 2 cm before the step of 12 cm
    assert env.robot.ground_drop(0.01).abs().max() < 1e-4
    drop = env.robot.ground_drop(0.03)
    assert drop[:, ~front].abs().max() < 1e-4
    torch.testing.assert_close(drop[:, front], torch.full_like(drop[:, front], 0.12))
    place(env, "stairs_up")  # a step up is no edge to fall from
    put(env, 0.6 - 0.02 - feet.max().item())
    assert env.robot.ground_drop(0.03).abs().max() < 1e-4


def test_leaving_the_tile_ends_an_episode_by_the_clock(env):
    place(env, "flat")
    qpos, qvel = env.sim.qpos.clone(), env.sim.qvel.clone()
    qpos[0, 0], qpos[1, 1] = CROSSED + 0.05, -CROSSED - 0.05
    env.sim.write_state(torch.ones(8, dtype=torch.bool), qpos, qvel, qpos[:, 7:])
    _, _, done, extras = env.step(holding(env))
    assert done.tolist() == [True, True] + 6 * [False]
    assert torch.equal(extras["time_outs"], done)
    assert env.robot.base_pos_w[:2, :2].abs().max() < 0.1  # they begin again in the middle


def test_worlds_that_run_out_of_memory_end_without_a_fall(env):
    curriculum = env._curriculum
    curriculum._way.fill_(2.0)  # and have not gone any of it: stuck, they would have failed
    step = env.sim.step

    def overflow(targets):
        step(targets)
        env.sim.overflowed[:3] = True

    env.sim.step = overflow
    _, rewards, done, extras = env.step(holding(env))
    assert done[:3].all()
    assert torch.equal(extras["time_outs"][:3], done[:3])
    assert not extras["imitation_valid"][:3].any()
    assert (rewards[:3] > -1.0).all()  # a fall costs 2
    assert extras["log"]["Episode/falls"] == 0
    assert curriculum.state_dict()["_tries"].sum() == 0
    # whoever evaluates may not take the next life for the same one
    assert env.measure().fallen.tolist() == 3 * [True] + 5 * [False]


def test_a_held_heading_is_steered_for(env):
    index = torch.zeros(8, dtype=torch.int64)
    command = torch.tensor([0.3, 0.0, 0.0]).expand(8, 3)
    env.reset(index, command, hold_heading=True)
    assert env.task.command[:, 2].abs().max() < 1e-6
    qpos, qvel = env.sim.qpos.clone(), env.sim.qvel.clone()
    turned = torch.tensor([0.2, -0.3, 1.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    start = env.robot.yaw
    qpos[:, 3] = torch.cos((start + turned) / 2)
    qpos[:, 4:6] = 0.0
    qpos[:, 6] = torch.sin((start + turned) / 2)
    env.sim.write_state(torch.ones(8, dtype=torch.bool), qpos, qvel, qpos[:, 7:])
    obs = env.step(holding(env))[0]
    rate = obs["command"][:, 2]
    # 1 rad/s a rad of error, at most 0.6 rad/s
    assert rate[:4].tolist() == pytest.approx([-0.2, 0.3, -0.6, 0.0], abs=0.03)


def test_worlds_show_the_tiles_of_their_curriculum(env):
    for _ in range(3):
        env.step(holding(env))
    state = env.state_dict()
    kind = state["tile"] // (2 * 2)
    assert torch.equal(kind, env._curriculum.kind)


def test_an_environment_goes_on_from_its_state_bit_for_bit(build):
    env, other = build("seed=1"), build("seed=2")
    actions = torch.randn(30, 8, 8, generator=torch.Generator().manual_seed(0))
    for action in actions[:10]:
        env.step(action)
    other.load_state_dict(env.state_dict())
    for action in actions[10:]:
        (one, r1, d1, _), (two, r2, d2, _) = env.step(action), other.step(action)
        assert torch.equal(r1, r2)
        assert torch.equal(d1, d2)
        assert all(torch.equal(one[key], two[key]) for key in one.keys())  # noqa: SIM118


def test_flat_ground_knows_no_terrain(build_env):
    env = build_env()
    assert env.terrains == ()
    assert env.sim.model.nhfield == 0
    assert env.state_dict()["tile"] is None


# --- trials ---------------------------------------------------------------------------------------


class Slide:
    """A policy that cheats: the base slides along its command, crouching where told to."""

    def __init__(self, env, crouching=()):
        self.env, self.crouching = env, list(crouching)

    def __call__(self, obs):
        env = self.env
        velocity = torch.zeros(env.num_envs, env.sim.qvel.shape[1])
        yaw, speed = env.robot.yaw, env.task.command[:, 0]
        velocity[:, 0], velocity[:, 1] = speed * torch.cos(yaw), speed * torch.sin(yaw)
        qpos = env.sim.qpos.clone()
        qpos[:, :2] += 0.02 * velocity[:, :2]
        velocity[:, :2] = 0.0
        env.sim.write_state(torch.ones(env.num_envs, dtype=torch.bool), qpos, velocity, qpos[:, 7:])
        action = holding(env)
        crawl = env.keyframe_joint_pos[[env.skills.index("crawl")]]
        action[self.crouching] = env._postures.holding(crawl)
        return action


def test_who_gets_far_enough_in_time_succeeds(build, monkeypatch):
    monkeypatch.setattr("kiras_rl.evaluation.terrain.TIME_LIMIT", 2.5)
    env = build("env.terminations.episode_length=21")
    terrain = torch.full((8,), env.terrains.index("flat"))
    speed = torch.tensor([2.0, 2.0, 3.0, 3.0, 1.0, 1.0, 2.0, 2.0])
    trials = Trials(terrain, torch.zeros_like(terrain), torch.zeros_like(terrain), speed)
    slow = torch.arange(8) >= 6

    class Idle(Slide):
        def __call__(self, obs):
            keep = env.sim.qpos[slow].clone()
            action = super().__call__(obs)
            qpos = env.sim.qpos.clone()
            qpos[slow] = keep
            env.sim.write_state(slow, qpos, torch.zeros_like(env.sim.qvel), qpos[:, 7:])
            return action

    outcomes = run_trials(env, Idle(env), trials)
    # 3 m at 1 m/s take longer than 2.5 s, and the last two do not move
    assert outcomes.success.tolist() == 4 * [True] + 4 * [False]
    assert not outcomes.fell.any()
    assert torch.equal(outcomes.strict, outcomes.success)


def test_who_crouches_succeeds_but_does_not_keep_its_keyframe(build):
    env = build("env.terminations.episode_length=21")
    flat = torch.full((8,), env.terrains.index("flat"))
    speed = torch.full((8,), 0.6)  # slow enough to have crouched for most of the way
    trials = Trials(flat, torch.zeros_like(flat), torch.zeros_like(flat), speed)
    outcomes = run_trials(env, Slide(env, crouching=(0, 1)), trials)
    assert outcomes.success.all() and outcomes.strict[2:].all()
    assert outcomes.kept.tolist() == 2 * [False] + 6 * [True]


def test_shares_are_those_of_type_and_skill(build):
    env = build("num_envs=45", "env.terminations.episode_length=21")
    result = evaluate_terrain(env, holding_policy(env), robots=1, level=0, speeds=(3.0, 3.0))
    assert result.terrains == tuple(name for name in env.terrains if name != "flat")
    assert result.success.shape == (9, 5)
    assert result.score() == pytest.approx(2.0)  # who holds its pose gets nowhere
    scalars = result.as_scalars()
    assert scalars["Eval_terrain/success_stairs_up"] == 0.0
    assert scalars["Eval_walk/terrain_strict"] == 0.0


def holding_policy(env):
    return lambda obs: holding(env)
