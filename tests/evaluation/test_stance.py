"""Height and pitch over the ground that a robot stands on."""

from __future__ import annotations

import math

import pytest
import torch

from kiras_rl.evaluation.stance import Stance, forward, line_below

IS_FRONT = torch.tensor([[True, True, False, False]])


def test_the_line_goes_through_the_feet_that_stand():
    # Rear feet 0.2 m behind and 0.3 m below the base; in front one stands 0.1 m higher, one swings.
    ahead = torch.tensor([[0.2, 0.3, -0.2, -0.2]])
    up = torch.tensor([[-0.2, 5.0, -0.3, -0.3]])
    stands = torch.tensor([[True, False, True, True]])
    height, pitch = line_below(ahead, up, stands, IS_FRONT)
    assert height.item() == pytest.approx(0.25)  # halfway between them
    assert pitch.item() == pytest.approx(-math.atan(0.1 / 0.4))  # uphill: nose up


@pytest.mark.parametrize("stands", [[True, True, False, False], [False, False, True, True]])
def test_there_is_no_line_without_front_or_rear_feet(stands):
    height, pitch = line_below(torch.ones(1, 4), torch.ones(1, 4), torch.tensor([stands]), IS_FRONT)
    assert height.isnan().all() and pitch.isnan().all()


def test_what_is_ahead_lies_along_the_heading():
    # Nose down by 30 degrees, rolled not at all: gravity is (sin, 0, -cos) in the base frame.
    gravity_b = torch.tensor([[math.sin(math.pi / 6), 0.0, -math.cos(math.pi / 6)]])
    points = torch.tensor([[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]])
    assert forward(gravity_b, points)[0].tolist() == pytest.approx(
        [math.cos(math.pi / 6), 0.0, math.sin(math.pi / 6)], abs=1e-6
    )


def test_on_level_ground_height_and_pitch_are_those_of_the_keyframe(build_env):
    still = ("env.observations.noise=false", "env.skills.joint_noise=0")
    pushes = ("env.randomization.push_velocity=null", "env.skills.velocity_noise=0")
    env = build_env(*still, *pushes, num_envs=5)
    skill = torch.arange(5)
    env.reset(skill, torch.zeros(5, 3))
    action, stance = env._action.clone(), Stance(env, skill)
    env.step(action)
    height, pitch = stance.read(env.measure())
    torch.testing.assert_close(height, env.keyframe_height, atol=0.005, rtol=0)
    torch.testing.assert_close(pitch, env.keyframe_pitch, atol=0.02, rtol=0)
