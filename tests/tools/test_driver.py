"""One robot in C MuJoCo: what it measures, when it falls, what a script records."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from kiras_rl.deploy.policy import OnboardPolicy, PolicyError
from kiras_rl.export import export_policy
from kiras_rl.robots.robot import RobotError
from kiras_rl.tools.driving.driver import Driver
from kiras_rl.tools.driving.script import (
    Segment,
    default_script,
    parse_command,
    parse_script,
    record,
)
from kiras_rl.tools.shared.outputs import save_arrays

HIGH = 1.0  # m: nothing touches the ground for some steps


@pytest.fixture
def driver(still_file):
    """Drive a robot that always aims at the default pose."""
    return Driver(OnboardPolicy(still_file))


def fly(driver, quat=(1, 0, 0, 0), lin_vel=(0, 0, 0), ang_vel=(0, 0, 0)):
    """Throw the robot: orientation, velocity in the world, angular velocity in the base.

    Its legs are where the policy wants them, so that they do not swing and move the base.
    """
    driver.data.qpos[7:] = driver.metadata.default_joint_pos
    driver.data.qpos[2:7] = (HIGH, *quat)
    driver.data.qvel[:6] = (*lin_vel, *ang_vel)
    return driver.step()


def about(axis, degrees):
    """Return the quaternion of a rotation about x, y or z."""
    half = np.deg2rad(degrees) / 2
    return (np.cos(half), *(np.sin(half) * np.eye(3)["xyz".index(axis)]))


def test_a_step_is_four_substeps_of_five_milliseconds(driver):
    sample = driver.step()
    assert driver.data.time == pytest.approx(0.02)
    assert sample.time == driver.time == 0.02


def test_it_stands_in_the_default_pose(driver):
    """Legs of 2 x 0.16 m at 0.8 rad and a foot of 16 mm would be 0.239 m; it sags a little."""
    for _ in range(100):
        sample = driver.step()
    assert 0.2 < sample.base_height < 0.32 * np.cos(0.8) + 0.016
    assert sample.foot_contact.all()
    assert not sample.fallen
    np.testing.assert_allclose(sample.lin_vel, 0, atol=0.03)
    assert sample.joint_torque.shape == sample.joint_pos.shape == (8,)
    assert 0.3 < np.abs(sample.joint_torque).max() < 1.5  # knees carry 2.2 kg


def test_the_command_and_skill_are_those_of_the_task(driver):
    driver.set_task("stilt", (0.3, 0.1, -0.2))
    sample = driver.step()
    assert sample.skill == 2
    np.testing.assert_array_equal(sample.command, (0.3, 0.1, -0.2))


def test_velocity_is_along_the_heading(driver):
    """Heading to the left (world y): world velocity (0, 1) is forward, (-1, 0) to the left."""
    sample = fly(driver, about("z", 90), lin_vel=(-0.5, 1, 0))
    np.testing.assert_allclose(sample.lin_vel[:2], (1, 0.5), atol=0.05)
    assert sample.lin_vel[2] == pytest.approx(-9.81 * 0.02, abs=0.02)


def test_a_pitched_base_still_moves_along_the_ground(driver):
    sample = fly(driver, about("y", 30), lin_vel=(1, 0, 0))
    np.testing.assert_allclose(sample.lin_vel[:2], (1, 0), atol=0.05)


@pytest.mark.parametrize(("axis", "name"), [("x", "roll"), ("y", "pitch")])
def test_roll_and_pitch_have_the_sign_of_the_rotation(driver, axis, name):
    sample = fly(driver, about(axis, 20))
    assert np.rad2deg(getattr(sample, name)) == pytest.approx(20, abs=2)


def test_yaw_rate_is_about_the_vertical(driver):
    """A base on its side turns about its own y axis, which is the vertical."""
    sample = fly(driver, about("x", 90), ang_vel=(0, 2, 0))
    assert sample.yaw_rate == pytest.approx(2, abs=0.1)


def test_nothing_touches_the_ground_in_the_air(driver):
    assert not fly(driver).foot_contact.any()


@pytest.mark.parametrize(("degrees", "fallen"), [(50, False), (70, True), (180, True)])
def test_leaning_sixty_degrees_from_the_posture_is_a_fall(driver, degrees, fallen):
    assert fly(driver, about("x", degrees)).fallen is fallen


def test_leaning_counts_from_the_nearer_of_two_postures(driver):
    """70 degrees nose up is 55 from pitch_up, where it comes from, and 85 from pitch_down."""
    driver.reset("pitch_up")
    driver.set_task("pitch_up", (0, 0, 0))
    driver.set_task("pitch_down", (0, 0, 0))
    assert not fly(driver, about("y", -70)).fallen
    driver.set_task("pitch_down", (0, 0, 0))
    assert fly(driver, about("y", -70)).fallen


def test_the_base_on_the_ground_is_a_fall(driver):
    driver.data.qpos[2] = 0.02
    driver.data.qpos[7:] = [1.57, 0] * 4  # legs stretched backward
    assert driver.step().fallen


def test_a_push_changes_the_velocity(driver):
    fly(driver)
    driver.push((0, 0.7, 0))
    assert driver.step().lin_vel[1] == pytest.approx(0.7, abs=0.05)


def test_reset_stands_in_the_posture_with_feet_just_above_the_ground(driver):
    driver.reset("pitch_up")
    posture = driver.metadata.keyframes["pitch_up"]
    feet = [driver.data.geom(name).xpos[2] for name in driver.robot.foot_geoms]
    assert min(feet) == pytest.approx(0.016 + 0.002, abs=1e-6)
    assert driver.data.qpos[2] == pytest.approx(0.2 + 0.002, abs=1e-3)
    np.testing.assert_array_equal(driver.data.qpos[7:], posture.joint_pos)
    np.testing.assert_array_equal(driver.data.ctrl, posture.joint_pos)
    np.testing.assert_array_equal(driver.data.qvel, 0)


def test_gains_and_limits_are_those_of_the_policy(make_metadata, make_policy, tmp_path):
    metadata = make_metadata(kp=[7.0] * 8, kd=[0.3] * 8, torque_limit=[1.5] * 8)
    export_policy(make_policy(metadata), metadata, tmp_path / "a.onnx")
    model = Driver(OnboardPolicy(tmp_path / "a.onnx")).model
    assert model.actuator_gainprm[:, [4, 6]].tolist() == [[7.0, 0.3]] * 8  # of a DC motor
    assert model.actuator_forcerange.tolist() == [[-1.5, 1.5]] * 8


def test_a_policy_for_other_joints_is_refused(still_file):
    policy = OnboardPolicy(still_file)
    names = policy.metadata.joint_names[::-1]
    policy.metadata = dataclasses.replace(policy.metadata, joint_names=names)
    with pytest.raises(RobotError, match=r"trained for the joints HR_KFE, .* has FL_HFE"):
        Driver(policy)


def test_a_wrong_command_is_refused(driver):
    with pytest.raises(PolicyError, match="a command is v_x, v_y and yaw rate"):
        driver.set_task("walk", (0.3, 0.0))


def test_a_recorded_script_has_one_row_a_step(driver, tmp_path):
    script = [Segment(0.2, "walk", (0, 0, 0)), Segment(0.1, "crawl", (0.3, 0, 0))]
    trace = record(driver, script)
    np.testing.assert_allclose(trace.time, 0.02 * np.arange(1, 16))
    assert trace.segment.tolist() == [0] * 10 + [1] * 5
    assert trace.skill.tolist() == [0] * 10 + [1] * 5
    assert trace.command[:, 0].tolist() == [0.0] * 10 + [0.3] * 5
    assert trace.qpos.shape == (15, 15)
    save_arrays(trace.arrays(), tmp_path / "trace.npz", "test")
    saved = np.load(tmp_path / "trace.npz")
    np.testing.assert_array_equal(saved["base_height"], trace.base_height)
    assert saved["skills"].tolist() == list(trace.skills)


def test_a_fallen_robot_starts_again(make_metadata, make_policy, tmp_path):
    """Legs stretched backward carry nothing: the base drops, and starts again at 0.3 m."""
    metadata = make_metadata()
    networks = make_policy(metadata, gain=0.0)
    networks.actor[-1].bias.data[:] = torch.tensor([1.54, 3.2] * 4)  # (1.57, 0) rad
    export_policy(networks, metadata, tmp_path / "a.onnx")
    trace = record(Driver(OnboardPolicy(tmp_path / "a.onnx")), [Segment(2.0, "stilt", (0.3, 0, 0))])
    falls = np.flatnonzero(trace.fallen)
    assert len(falls) > 1
    assert trace.base_height[falls[0]] < 0.1
    assert trace.base_height[falls[0] + 1] == pytest.approx(0.3, abs=0.02)


def test_the_default_script_shows_every_skill(make_metadata):
    script = default_script(make_metadata(), (0.2, 0, 0))
    assert script[0] == Segment(1.0, "walk", (0, 0, 0))
    assert [part.skill for part in script[1:]] == list(make_metadata().skills)
    assert {(part.duration, part.command) for part in script[1:]} == {(4.0, (0.2, 0, 0))}


def test_a_script_is_read(make_metadata):
    assert parse_script("walk:4:0.3, crawl:0.5:-0.1:0.2:0.4", make_metadata()) == [
        Segment(4.0, "walk", (0.3, 0.0, 0.0)),
        Segment(0.5, "crawl", (-0.1, 0.2, 0.4)),
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "a script's part is skill:seconds:v_x"),
        ("walk", "a script's part is .* e.g. walk:4:0.3, not 'walk'"),
        ("walk:4", "a script's part is"),
        ("walk:-1:0.3", "a script's part is"),
        ("walk:inf:0.3", "a script's part is"),
        ("walk:4:fast", "a command is v_x"),
        ("walk:4:1:2:3:4", "a command is v_x"),
        ("walk:4:0.3,fly:1:0", "unknown skill 'fly' in the script; this policy has: walk, crawl"),
    ],
)
def test_a_script_that_cannot_be_read_is_named(make_metadata, text, message):
    with pytest.raises(PolicyError, match=message):
        parse_script(text, make_metadata())


def test_a_command_may_be_short():
    assert parse_command("0.3") == (0.3, 0, 0)
    assert parse_command("0.3,0,-0.5") == (0.3, 0, -0.5)
    with pytest.raises(PolicyError, match="not 'nan'"):
        parse_command("nan")
