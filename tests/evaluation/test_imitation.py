"""The imitation protocol's numbers, on motions that can be judged by eye."""

from __future__ import annotations

import dataclasses
import json
from types import SimpleNamespace

import pytest
import torch

from kiras_rl.evaluation.dtw import dtw
from kiras_rl.evaluation.imitation import (
    STEPS,
    Motion,
    keyframe_poses,
    pose_features,
    record_motion,
    summarize,
)
from kiras_rl.interfaces import EXTRA_IMITATION

DT = 0.02  # s: 120 steps are 2.4 s
ENV = SimpleNamespace(
    skills=("low", "high"),
    keyframe_height=torch.tensor([0.2, 0.3]),
    keyframe_pitch=torch.tensor([0.0, 0.1]),
    keyframe_joint_pos=torch.tensor([[0.0, 0.0], [0.5, -0.5]]),
    mass=2.0,
)


@pytest.fixture
def motion():
    """Four robots of two joints and two feet, two a skill, that rest in their keyframes."""
    skill = torch.tensor([0, 1, 0, 1])
    pitch = ENV.keyframe_pitch[skill]
    gravity_b = torch.stack([pitch.sin(), torch.zeros(4), -pitch.cos()], dim=1)
    shape = (STEPS, 4, 2)
    return Motion(
        skill=skill,
        height=ENV.keyframe_height[skill].repeat(STEPS, 1),
        pitch=pitch.repeat(STEPS, 1),
        velocity=torch.full((STEPS, 4), 0.5),
        gravity_b=gravity_b.repeat(STEPS, 1, 1),
        joint_pos=ENV.keyframe_joint_pos[skill].repeat(STEPS, 1, 1),
        peak_torque=torch.zeros(shape),
        joint_torque=torch.zeros(shape),
        power=torch.zeros(STEPS, 4),
        stands=torch.ones(shape, dtype=torch.bool),
        foot_height=torch.zeros(shape),
        alive=torch.ones(STEPS, 4, dtype=torch.bool),
        step_dt=DT,
    )


def results(motion):
    """Return the results of both skills."""
    return summarize(motion, ENV).skills.values()


def put(motion, robot, skill, steps=slice(None)):
    """Put a robot into the keyframe of a skill for some steps."""
    other = motion.skill.tolist().index(skill)
    for signal in (motion.height, motion.pitch, motion.gravity_b, motion.joint_pos):
        signal[steps, robot] = signal[0, other].clone()


def step_in_turn(motion, robot):
    """Let the first foot stand and swing for 0.2 s each, swing after swing 1 cm higher."""
    step = torch.arange(STEPS)
    swings = step % 20 >= 10  # from steps 10, 30, 50, 70, 90 and, not landing any more, 110
    motion.stands[:, robot, 0] = ~swings
    motion.foot_height[:, robot, 0] = torch.where(step % 20 == 15, 0.01 * (1 + step // 20), 0.0)


# --- posture -------------------------------------------------------------------------------------


def test_a_robot_at_rest_in_its_keyframe_is_perfect(motion):
    imitation = summarize(motion, ENV)
    for result in imitation.skills.values():
        distances = (result.dtw, result.dtw_std, result.height_error, result.pitch_error)
        assert distances == pytest.approx((0, 0, 0, 0), abs=1e-6)
        assert (result.cosine, result.centred_cosine, result.accuracy) == pytest.approx((1, 1, 1))
        assert (result.frequency, result.duty, result.power, result.falls) == (0, 1, 0, 0)
    assert imitation.confusion.tolist() == [[1, 0], [0, 1]]


def test_the_distance_is_the_sum_over_the_steps_averaged_over_robots(motion):
    motion.joint_pos[:, 0] += torch.tensor([0.3, -0.4])  # 0.5 rad, the other robot 0
    motion.height[:, 1] += 0.01  # a centimetre counts as 0.1 rad
    low, high = results(motion)
    assert (low.dtw, low.dtw_std, low.dtw_frame) == pytest.approx((30.0, 30.0, 0.25))
    assert (high.dtw, high.dtw_std, high.dtw_frame) == pytest.approx((6.0, 6.0, 0.05), rel=1e-4)
    assert (low.height_error, high.height_error) == pytest.approx((0.0, 0.005), abs=1e-6)


def test_the_distance_is_that_of_dynamic_time_warping(motion):
    motion.joint_pos.add_(torch.randn_like(motion.joint_pos))
    keyframe = keyframe_poses(ENV)[0].expand(STEPS, -1)
    expected = [dtw(motion.poses()[:, robot], keyframe) for robot in (0, 2)]
    assert next(iter(results(motion))).dtw == pytest.approx(sum(expected) / 2, rel=1e-5)


def test_errors_are_those_of_each_step(motion):
    motion.height[::2, [0, 2]] += 0.02
    motion.height[1::2, [0, 2]] -= 0.02
    motion.pitch[:, 3] -= 0.04
    low, high = results(motion)
    assert low.height_error == pytest.approx(0.02)
    assert high.pitch_error == pytest.approx(0.02)


def test_the_cosine_is_that_of_angles_weighted_gravity_and_height(motion):
    # low: gravity 3 x 1, height 10 x 0.2, length sqrt 13; as much again at a right angle: 45 deg
    motion.joint_pos[:, [0, 2], 0] = 13**0.5
    low, high = results(motion)
    assert (low.cosine, high.cosine) == pytest.approx((0.5**0.5, 1.0))


def test_the_centred_cosine_tells_opposite_skills_apart(motion):
    put(motion, robot=0, skill=1)
    put(motion, robot=2, skill=1)
    low, high = results(motion)
    assert low.cosine > 0.9
    assert (low.centred_cosine, high.centred_cosine) == pytest.approx((-1.0, 1.0), abs=1e-5)


def test_the_steps_of_a_skill_are_counted_by_their_nearest_keyframe(motion):
    put(motion, robot=0, skill=1, steps=slice(30, 60))  # 30 steps of 240
    imitation = summarize(motion, ENV)
    assert imitation.confusion.flatten().tolist() == pytest.approx([0.875, 0.125, 0.0, 1.0])
    assert [r.accuracy for r in imitation.skills.values()] == pytest.approx([0.875, 1.0])


# --- gait ----------------------------------------------------------------------------------------


def test_stepping_is_measured_on_every_foot(motion):
    step_in_turn(motion, 0)
    step_in_turn(motion, 2)
    low, high = results(motion)
    assert low.frequency == pytest.approx(6 / 2.4 / 2)  # one foot of two
    assert low.duty == pytest.approx(0.75)
    assert low.clearance == pytest.approx(0.03)  # 1 to 5 cm; the sixth swing does not end
    assert (high.frequency, high.duty) == (0.0, 1.0)
    assert high.clearance != high.clearance  # there is no swing


def test_a_swing_that_began_before_does_not_count(motion):
    step_in_turn(motion, 0)
    motion.stands[:4, 0, 1] = False
    motion.foot_height[:4, 0, 1] = 0.5
    assert next(iter(results(motion))).clearance == pytest.approx(0.03)


def test_power_torque_and_cost_of_transport(motion):
    motion.joint_torque[:] = torch.tensor([1.0, -2.0])
    motion.peak_torque[:] = torch.tensor([1.0, 2.0])
    motion.peak_torque[7, 0, 1] = 2.4
    motion.power[:] = 11.0
    motion.power[7, 0] = 3.0
    low, high = results(motion)
    assert high.power == pytest.approx(11.0)
    assert high.torque == pytest.approx(1.5)
    assert (low.peak_torque, high.peak_torque) == pytest.approx((2.2, 2.0))
    assert high.cost_of_transport == pytest.approx(11.0 / (2.0 * 9.81 * 0.5))
    assert low.power == pytest.approx(11.0 - 8.0 / 240)


# --- falls ---------------------------------------------------------------------------------------


def test_a_robot_counts_until_it_falls(motion):
    step_in_turn(motion, 0)
    motion.stands[:, 0, 1] = motion.stands[:, 0, 0]
    motion.foot_height[:, 0, 1] = motion.foot_height[:, 0, 0]
    for signal in (motion.height, motion.velocity, motion.peak_torque, motion.power):
        signal[60:, 0] = 9.0
    motion.alive[60:, 0] = False
    low, high = results(motion)
    assert (low.falls, high.falls) == (0.5, 0.0)
    assert (low.dtw, low.height_error, low.power) == pytest.approx((0, 0, 0), abs=1e-5)
    assert (low.velocity, low.peak_torque) == (0.5, 0.0)
    assert low.frequency == pytest.approx(3 / 1.2 / 2)  # robot 2 stands
    assert low.clearance == pytest.approx(0.015)  # 1 and 2 cm; the third swing ends in the fall


def test_a_skill_in_which_all_fell_at_once_has_no_numbers(motion):
    motion.alive[:, [0, 2]] = False
    motion.velocity[:, 1] = -0.5
    imitation = summarize(motion, ENV)
    values = imitation.as_dict()
    low, high = values["skills"].values()
    assert low["falls"] == 1.0
    assert {value for key, value in low.items() if key != "falls"} == {None}
    assert values["confusion"] == [[None, None], [0.0, 1.0]]
    assert high["dtw"] == pytest.approx(0.0, abs=1e-5)
    assert high["cost_of_transport"] is None  # one goes as fast back as the other ahead
    assert json.loads(json.dumps(values, allow_nan=False)) == values


# --- the environment -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def env(build_env):
    calm = [f"env.randomization.{name}=null" for name in ("push_velocity", "payload", "com_shift")]
    return build_env(*calm, num_envs=5)


def test_poses_are_weighted_as_by_the_discriminator(env):
    skill = torch.arange(5)
    env.reset(skill, torch.zeros(5, 3))
    for _ in range(3):
        extras = env.step(0.1 * torch.randn(5, 8))[3]
    now = env.measure()
    poses = pose_features(now.gravity_b, now.joint_pos, now.base_height)
    distance = (poses - keyframe_poses(env)).norm(dim=1)
    expected = (extras[EXTRA_IMITATION] - env.keyframe_features).norm(dim=1)
    assert (distance > 0.01).all()
    torch.testing.assert_close(distance, expected)


def test_what_is_recorded_are_the_steps_after_the_first_second(env):
    motion = record_motion(env, lambda obs: torch.zeros(5, 8), command=0.0)
    signals = dataclasses.asdict(motion)
    shapes = {name: tuple(signals[name].shape) for name in ("height", "gravity_b", "foot_height")}
    assert shapes == {
        "height": (STEPS, 5), "gravity_b": (STEPS, 5, 3), "foot_height": (STEPS, 5, 4),
    }  # fmt: skip
    assert motion.skill.tolist() == [0, 1, 2, 3, 4]
    # Asked for the default pose the robots stand in it, on all feet: 2.178 kg at rest.
    assert motion.alive.all() and motion.stands[50:].all()
    assert motion.foot_height[50:].abs().max() < 0.01
    assert summarize(motion, env).skills["walk"].power < 0.2
    assert env.mass == pytest.approx(1.43315 + 4 * (0.14854 + 0.03764), abs=1e-4)
