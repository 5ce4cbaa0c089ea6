"""The whole loop on a simulated Solo-8 and a clock of its own: driver, runtime and a hand."""

from __future__ import annotations

import numpy as np
import pytest
from rig import Rig

from kiras_rl.dataset import load_dataset
from kiras_rl.deploy.runtime.blackbox import save
from kiras_rl.deploy.runtime.messages import Mode, Request, State


@pytest.fixture
def rig(tmp_path):
    return Rig("solo8", tmp_path)


def test_nothing_moves_before_the_motors_are_switched_on(rig):
    rig.run(1.0)
    assert rig.runtime.state == State.CONNECTED
    assert set(rig.modes) == {Mode.OFF}
    rig.press(Request.STAND)
    rig.run(0.1)
    assert rig.log[-1] == "refused to stand: not possible while connected"


def test_from_lying_to_a_skill_and_down_again(rig, tmp_path):
    low = rig.height
    rig.walk("walk", (0.3, 0.0, 0.0))
    rig.run(3.0)
    place = rig.plant.data.qpos[0]
    assert place > 0.3  # m, of 0.9 that were asked for with a start from rest
    rig.drive("crawl", (0.0, 0.0, 0.0))
    rig.run(2.0)
    assert rig.runtime.skill == rig.policy.metadata.skills.index("crawl")
    assert rig.height == pytest.approx(0.10, abs=0.03)  # m, the keyframe's
    rig.press(Request.LIE)
    rig.run_until(State.LYING)
    rig.run(0.5)
    assert rig.height == pytest.approx(low, abs=0.02)
    assert rig.driver.mode == Mode.DAMP
    assert rig.runtime.fault == ""

    save(rig.ring.rows(), rig.policy.metadata, tmp_path / "box", rig.log)
    box = load_dataset(tmp_path / "box")
    assert box.robot == "solo8"
    assert box.rate == pytest.approx(1000.0, rel=1e-3)
    assert len(box) == len(rig.modes) - (rig.modes[0] is None)
    assert box["joint_pos"][-1] == pytest.approx(rig.plant.data.qpos[7:], abs=0.02)
    assert set(np.unique(box["state"])) >= {State.LYING, State.RISING, State.POLICY}
    assert np.abs(box["joint_target"][box["mode"][:, 0] == Mode.SERVO]).max() < np.pi


def test_the_policy_takes_over_only_near_its_posture(rig):
    rig.run(0.8)
    rig.press(Request.ACKNOWLEDGE)
    rig.run_until(State.LYING)
    rig.press(Request.STAND)
    rig.run_until(State.STANDING)
    rig.run(0.019)
    rig.plant.data.qpos[7] += 0.5  # somebody pushes a leg away
    rig.press(Request.WALK)
    rig.run(0.002)
    assert rig.runtime.state == State.STANDING
    assert "rad off its posture, 0.25 are allowed" in rig.log[-1]


def test_the_button_damps_in_the_same_tick_and_only_an_acknowledgement_ends_it(rig):
    rig.walk()
    rig.run(1.0)
    rig.wish["emergency"] = 1
    before = len(rig.modes)
    rig.run(0.02)
    assert rig.modes[before] == Mode.DAMP
    assert rig.runtime.state == State.DAMPED
    assert rig.runtime.fault == "emergency"
    rig.wish["emergency"] = 0
    rig.press(Request.STAND)
    rig.run(1.0)
    assert rig.runtime.state == State.DAMPED
    rig.press(Request.ACKNOWLEDGE)
    rig.run_until(State.LYING)
    rig.press(Request.STAND)
    rig.run_until(State.STANDING)


def test_without_the_operator_it_slows_down_and_lies_down(rig):
    rig.walk("walk", (0.4, 0.0, 0.0))
    rig.run(2.0)
    assert rig.runtime.command[0] == pytest.approx(0.4)
    rig.silent = True
    rig.run(0.5 + 0.4 + 0.06)  # silent for 0.5 s, then from 0.4 m/s to rest at 1 m/s^2
    assert rig.runtime.state == State.POLICY
    assert rig.runtime.command[0] == 0.0
    rig.run_until(State.LYING, 8.0)
    assert "lies down: the operator is lost" in rig.log


def test_a_pad_that_is_pulled_out_counts_as_no_operator(rig):
    rig.walk("walk", (0.4, 0.0, 0.0))
    rig.run(1.0)
    rig.wish["connected"] = 0
    rig.run_until(State.LYING, 8.0)
    assert "lies down: the operator is lost" in rig.log


def test_commands_stay_in_the_policy_s_range_and_change_slowly(rig):
    rig.walk()
    rig.run(0.6)
    rig.drive("walk", (9.0, 9.0, np.nan))
    rig.run(0.1)
    assert 0.08 <= rig.runtime.command[0] <= 0.12  # 1 m/s^2
    rig.run(1.0)
    assert rig.runtime.command == pytest.approx([0.6, 0.0, 0.0])  # the file's range
    assert rig.runtime.state == State.POLICY


def test_a_dead_man_s_button_that_is_let_go_stops(rig):
    from kiras_rl.deploy.runtime.machine import Runtime

    rig.runtime = Runtime(rig.policy, rig.profile, rig.log.append, deadman=True)
    rig.walk("walk", (0.3, 0.0, 0.0))
    rig.run(1.0)
    assert rig.runtime.command[0] == pytest.approx(0.3)
    rig.wish["held"] = 0
    rig.run(0.4)
    assert rig.runtime.command[0] == 0.0
    assert rig.runtime.state == State.POLICY


def test_a_runtime_that_stops_is_held_then_damped_and_says_so_when_it_is_back(rig):
    rig.walk()
    rig.run(1.0)
    rig.stopped = True
    before = len(rig.modes)
    rig.run(0.3)
    modes = rig.modes[before:]
    # valid for 40 ms from the last order, which is at most one period old; held for 100 ms
    assert Mode.HOLD in modes[20:41]
    assert modes[141] == Mode.DAMP
    rig.stopped = False
    rig.run(0.1)
    assert rig.runtime.state == State.DAMPED
    assert rig.runtime.fault in ("driver", "deadline")


def test_a_runtime_that_is_gone_is_damped_at_once(rig):
    rig.walk()
    rig.run(0.5)
    rig.channel.runtime.leave()
    rig.stopped = True
    before = len(rig.modes)
    rig.run(0.05)
    assert set(rig.modes[before:]) == {Mode.DAMP}


def test_it_lies_down_before_it_ends(rig):
    rig.walk("walk", (0.3, 0.0, 0.0))
    rig.run(1.0)
    rig.press(Request.QUIT)
    rig.run(0.1)
    assert not rig.runtime.finished
    rig.run_until(State.LYING)
    rig.run(0.04)
    assert rig.runtime.finished


@pytest.mark.parametrize("seed", range(3))
def test_go1_rises_from_however_it_lies(tmp_path, seed):
    rig = Rig("go1", tmp_path, seed)
    rig.walk("stilt")
    rig.run(2.0)
    assert rig.height == pytest.approx(0.35, abs=0.03)
    assert rig.runtime.fault == ""
