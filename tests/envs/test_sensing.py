"""What the robot's own sensors say, against the motion that they should have seen."""

from __future__ import annotations

import pytest
import torch

from kiras_rl.config import ConfigError
from kiras_rl.envs import rotations
from kiras_rl.interfaces import CRITIC, PROPRIO

WORLDS = 8
CALM = (
    "env.observations.noise=false",
    "env.skills.velocity_noise=0",
    "env.skills.switch_probability=0",
    "env.commands.resample_probability=0",
    "env.observations.proprio.base_ang_vel={}",
    "env.observations.proprio.joint_vel.scale=1",
)


@pytest.fixture
def build(build_env, nominal):
    """Return a function that builds worlds in which nothing errs but the sensors named."""

    def build_with(**errors):
        ranges = [f"env.randomization.{name}={value}" for name, value in errors.items()]
        return build_env(*nominal, *CALM, *ranges, num_envs=WORLDS)

    return build_with


def split(env, values):
    """Return the terms of proprio by name."""
    names = [term["name"] for term in env.describe()["observation"]]
    sizes = [term["size"] for term in env.describe()["observation"]]
    return dict(zip(names, values.split(sizes, dim=1), strict=True))


def seen(env, obs):
    """Return what the robots read, and what is true, by term."""
    width = obs[PROPRIO].shape[1]
    return split(env, obs[PROPRIO]), split(env, obs[CRITIC][:, :width])


def test_encoders_are_off_by_the_same_angle_all_along(build):
    env = build(encoder_bias="[-0.1,0.1]")
    errors = []
    for _ in range(3):
        read, true = seen(env, env.step(torch.randn(WORLDS, 8))[0])
        errors.append(read["joint_pos"] - true["joint_pos"])
        torch.testing.assert_close(read["projected_gravity"], true["projected_gravity"])
    torch.testing.assert_close(errors[0], errors[2])
    assert 0.08 < errors[0].abs().max() <= 0.1
    assert errors[0].std() > 0.03


def test_a_motor_turns_to_where_its_encoder_reads_the_target(build):
    env = build(encoder_bias="[0.1,0.1]")
    standing = torch.zeros(WORLDS, dtype=torch.int64)
    obs = env.reset(standing, torch.zeros(WORLDS, 3))
    held = seen(env, obs)[0]["last_action"]
    start = env.sim.qpos[:, 7:].clone()
    env.step(held)  # which holds what the encoders read
    assert (env.sim.qpos[:, 7:] - start).abs().max() < 0.02


def test_a_tilted_imu_turns_gravity_and_rates(build):
    env = build(imu_tilt="[0.05,0.05]", gyro_bias="[0.2,0.2]")
    read, true = seen(env, env.step(torch.randn(WORLDS, 8))[0])
    tilt = torch.tensor([0.05, 0.05, 0.0]).expand(WORLDS, 3)
    angle = tilt.norm(dim=1, keepdim=True)
    quat = torch.cat([(angle / 2).cos(), tilt / angle * (angle / 2).sin()], dim=1)
    base_from_imu = rotations.matrix(quat)

    def in_imu(vector):
        return (vector[:, None] @ base_from_imu).squeeze(1)

    gravity, rates = in_imu(true["projected_gravity"]), in_imu(true["base_ang_vel"]) + 0.2
    torch.testing.assert_close(read["projected_gravity"], gravity, atol=3e-3, rtol=0)
    torch.testing.assert_close(read["base_ang_vel"], rates, atol=2e-2, rtol=5e-3)
    torch.testing.assert_close(read["projected_gravity"].norm(dim=1), torch.ones(WORLDS))


@pytest.mark.parametrize("delay", [1, 2, 4])
def test_observations_are_late_by_physics_steps(build, delay):
    env = build(observation_delay=f"[{delay},{delay}]")
    env.reset()
    for _ in range(3):
        before = seen(env, env.get_observations())[1]  # what was true a control step ago
        read, true = seen(env, env.step(torch.randn(WORLDS, 8))[0])
    assert (read["joint_pos"] - true["joint_pos"]).abs().max() > 0.01
    if delay == 4:  # a whole control step
        for name in ("joint_pos", "joint_vel", "projected_gravity", "base_ang_vel"):
            torch.testing.assert_close(read[name], before[name], atol=1e-4, rtol=1e-4)
    if delay == 1:  # a physics step changes an angle by the velocity at its end
        then = true["joint_pos"] - 0.005 * true["joint_vel"]
        torch.testing.assert_close(read["joint_pos"], then, atol=1e-4, rtol=1e-4)


def test_observations_are_at_most_a_control_step_late(build):
    with pytest.raises(ConfigError, match=r"observation_delay=\[0, 5\]: at most a control step"):
        build(observation_delay="[0,5]")


def test_a_robot_that_has_just_begun_reads_no_past(build):
    env = build(observation_delay="[4,4]")
    for _ in range(3):
        env.step(torch.randn(WORLDS, 8))
    read, true = seen(env, env.reset())
    assert torch.equal(read["joint_pos"], true["joint_pos"])
    assert torch.equal(read["projected_gravity"], true["projected_gravity"])


def test_errors_stay_for_an_episode_and_are_drawn_anew_at_a_reset(build):
    env = build(encoder_bias="[-0.1,0.1]")
    before = env.state_dict()["sensors"]["errors"].clone()
    env.episode_length_buf = torch.where(torch.arange(WORLDS) == 2, env.max_episode_length - 1, 0)
    env.step(torch.zeros(WORLDS, 8))
    changed = (env.state_dict()["sensors"]["errors"] != before).any(dim=1)
    assert changed.tolist() == [i == 2 for i in range(WORLDS)]
