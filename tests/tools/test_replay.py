"""A black box in kiras-play: posed as it was measured, beside the keyframe of its skill."""

from __future__ import annotations

import numpy as np
import pytest

from kiras_rl.deploy.policy import OnboardPolicy, PolicyError
from kiras_rl.deploy.runtime.blackbox import ROW, save
from kiras_rl.deploy.runtime.messages import NANO, Mode, State
from kiras_rl.tools.driving.replay import Replay, load_log, policy_of
from kiras_rl.tools.driving.viewer import bindings
from kiras_rl.tools.driving.viewer.playback import Playback
from kiras_rl.tools.driving.viewer.stage import Stage
from kiras_rl.tools.driving.viewer.terminal import lines
from kiras_rl.tools.driving.viewer.view import View
from kiras_rl.tools.play import main

SECONDS, RATE = 0.5, 1000
TURN, NOD = 0.3, 0.1  # rad: yaw and pitch of the base, all the time


@pytest.fixture(scope="module")
def policy(still_file):
    return OnboardPolicy(still_file)


@pytest.fixture(scope="module")
def box(policy, tmp_path_factory):
    """Write half a second of a robot that bends its knees, and changes its skill halfway."""
    count, meta = round(SECONDS * RATE), policy.metadata
    rows = np.zeros(count, ROW)
    reading, order = rows["reading"], rows["order"]
    reading["seq"] = np.arange(1, count + 1)
    reading["time"] = 7 * NANO + np.arange(count) * (NANO // RATE)
    reading["mode"], order["state"] = Mode.SERVO, State.POLICY
    bend = np.linspace(0.0, 0.2, count)[:, None] * np.sign(meta.default_joint_pos)
    reading["joint_pos"][:, :8] = meta.default_joint_pos + bend
    cz, sz, cy, sy = np.cos(TURN / 2), np.sin(TURN / 2), np.cos(NOD / 2), np.sin(NOD / 2)
    reading["quat"] = cz * cy, -sz * sy, cz * sy, sz * cy  # yaw, then pitch
    reading["gyro"][:, 2], reading["torque"][:, 2] = 0.5, 1.5
    order["skill"][count // 2 :] = 1
    order["command"] = 0.3, 0.0, 0.5
    folder = tmp_path_factory.mktemp("log") / "blackbox_1"
    save(rows, meta, folder, ["7.000 runtime: skill crawl"])
    return folder


def test_the_robot_is_posed_as_it_was_measured(policy, box):
    log = load_log(box)
    replay = Replay(policy, log)
    samples = [replay.step() for _ in range(20)]
    for number, sample in enumerate(samples, start=1):
        frame = 20 * number  # a control period is 20 ms
        np.testing.assert_allclose(sample.joint_pos, log["joint_pos"][frame], atol=1e-6)
        assert sample.time == pytest.approx(0.02 * number)
        assert sample.pitch == pytest.approx(NOD, abs=1e-6)
        assert sample.yaw_rate == pytest.approx(0.5 * np.cos(NOD), abs=1e-6)
        assert sample.joint_torque[2] == 1.5
        assert sample.command == pytest.approx([0.3, 0.0, 0.5])
        assert not sample.fallen
        assert np.isnan(sample.lin_vel).all()
    heights = [sample.base_height for sample in samples]
    assert heights == sorted(heights, reverse=True)  # the knees bend
    # one leg: 0.16 cos 0.8 + 0.16 cos 0.8 + 0.016 = 0.239 m; the lower hip is 0.19 sin 0.1 lower
    assert heights[0] == pytest.approx(0.239 + 0.019, abs=0.003)


def test_the_lowest_foot_is_on_the_ground(policy, box):
    replay = Replay(policy, load_log(box))
    replay.step()
    feet = [replay.model.geom(name).id for name in replay.robot.foot_geoms]
    lowest = replay.data.geom_xpos[feet, 2].min() - replay.robot.foot_radius
    assert lowest == pytest.approx(0.0, abs=1e-9)


def test_the_ghost_stands_in_the_keyframe_of_the_skill_of_the_moment(policy, box):
    playback = Playback(policy, load_log(box), "a log")
    stage = Stage(playback.driver)
    for skill, steps in (("walk", 5), ("crawl", 10)):
        for _ in range(steps):
            playback.advance()
        stage.pose(side=0.45)
        ghost = stage.data.qpos[len(stage.data.qpos) // 2 :]
        posture = policy.metadata.keyframes[skill]
        assert playback.skills[playback.skill] == skill
        assert ghost[2] == pytest.approx(posture.base_height)
        np.testing.assert_allclose(ghost[7:], posture.joint_pos)


def test_time_stops_at_the_end_and_begins_again(policy, box):
    playback = Playback(policy, load_log(box), "a log")
    while not playback.paused:
        playback.advance()
    assert playback.notice == "0.5 of 0.5 s: policy, motors servo"
    assert playback.advance() is None
    bindings.press(playback, "R")
    assert playback.advance().time == pytest.approx(0.02)
    assert playback.telemetry.view()["time"] == pytest.approx([0.02])
    bindings.press(playback, "N")
    assert playback.advance().time == pytest.approx(0.04)
    assert playback.advance() is None


@pytest.mark.parametrize("key", ["P", "F", "L", "V", "Space", "2"])
def test_nothing_drives_a_log(policy, box, key):
    playback = Playback(policy, load_log(box), "a log")
    plain = Playback(policy, load_log(box), "a log")
    bindings.press(playback, key)
    seen, expected = playback.advance(), plain.advance()
    np.testing.assert_array_equal(seen.qpos, expected.qpos)
    assert (playback.skill, playback.tile) == (plain.skill, plain.tile)


def test_slow_motion_shows_what_lies_between(policy, box):
    replay, heights = Replay(policy, load_log(box)), []
    replay.step(after_substep=lambda: heights.append(float(replay.data.qpos[2])))
    assert len(heights) == replay.substeps
    assert heights == sorted(set(heights), reverse=True)


def test_a_terminal_shows_it(policy, box):
    playback = Playback(policy, load_log(box), "a log")
    playback.advance()
    assert "0.0 of 0.5 s: policy, motors servo" in "\n".join(lines(playback, View()))


@pytest.fixture
def error_of(capsys):
    def run(*words):
        assert main([str(word) for word in words]) == 2
        printed = capsys.readouterr()
        assert printed.err.count("\n") == 1
        return printed.err

    return run


def test_what_cannot_be_shown_is_one_line(box, tmp_path, error_of):
    assert "--log" in error_of("--log", tmp_path / "none")
    assert "no --table" in error_of("--log", box, "--table")
    assert "no --terrain" in error_of("--log", box, "--terrain", "stairs_up")


def test_the_policy_has_to_be_the_one_that_ran(box, make_metadata):
    log = load_log(box)
    assert policy_of(log, None).metadata.skills == log.skills  # what comes with the robot
    from rig import shipped

    with pytest.raises(PolicyError, match=r"the log is of solo8 .*, the policy of go1 .*name the"):
        policy_of(log, shipped("go1"))
