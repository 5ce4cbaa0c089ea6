"""The logic of examples/ros2 without ROS: what it would publish, and what it passes on."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from kiras_rl.deploy.runtime.driver import Channel
from kiras_rl.deploy.runtime.hands import Hand
from kiras_rl.deploy.runtime.messages import NANO, make_reading

EXAMPLE = Path(__file__).parents[3] / "examples" / "ros2" / "kiras_bridge.py"


@pytest.fixture(scope="module")
def ros2():
    spec = importlib.util.spec_from_file_location("kiras_bridge", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def channel(tmp_path):
    return Channel("solo8", tmp_path)


@pytest.fixture
def reading():
    reading = make_reading()
    reading["seq"], reading["time"] = 1, 5 * NANO
    reading["joint_pos"][:2], reading["joint_vel"][:2] = (0.5, -1.5), (2.0, 3.0)
    reading["torque"][:2] = 0.25, -0.5
    reading["quat"], reading["gyro"], reading["acc"] = (0.5, 0.5, -0.5, 0.5), (1, 2, 3), (0, 0, 9)
    return reading


def test_what_is_published(ros2, channel, reading):
    bridge = ros2.Bridge(channel, ("a", "b"))
    assert bridge.news(6 * NANO, 100 * NANO) is None
    channel.readings.put(reading)
    joints, imu = bridge.news(6 * NANO, 100 * NANO)
    assert joints["name"] == ["a", "b"]
    assert (joints["position"], joints["velocity"]) == ([0.5, -1.5], [2.0, 3.0])
    assert joints["effort"] == [0.25, -0.5]
    # measured a second before the moment that both clocks tell
    assert joints["header"]["stamp"] == {"sec": 99, "nanosec": 0}
    assert imu["orientation"] == {"x": 0.5, "y": -0.5, "z": 0.5, "w": 0.5}  # ROS has w last
    assert imu["angular_velocity"] == {"x": 1.0, "y": 2.0, "z": 3.0}
    assert imu["linear_acceleration"] == {"x": 0.0, "y": 0.0, "z": 9.0}
    assert bridge.news(6 * NANO, 100 * NANO) is None  # the same reading again


def test_fields_go_into_messages(ros2):
    message = SimpleNamespace(header=SimpleNamespace(stamp=SimpleNamespace()))
    ros2.fill(message, {"header": {"stamp": {"sec": 3}}, "position": [1.0]})
    assert (message.header.stamp.sec, message.position) == (3, [1.0])


def test_a_twist_reaches_the_wish_and_a_stick_comes_first(ros2, channel, make_metadata):
    hand, now = Hand(make_metadata()), 20 * NANO
    twist = SimpleNamespace(linear=SimpleNamespace(x=0.25, y=0.0), angular=SimpleNamespace(z=-0.5))
    ros2.Bridge(channel, ()).hear(twist, now)
    found = hand.wish(now, True, channel.guests.get())["command"]
    np.testing.assert_allclose(found, [0.25, 0.0, -0.5])
    hand.set_command((0.1, 0.0, 0.0))
    found = hand.wish(now, True, channel.guests.get())["command"]
    np.testing.assert_allclose(found, [0.1, 0.0, 0.0], rtol=1e-6)


def test_without_arguments_it_is_one_line():
    done = subprocess.run([sys.executable, EXAMPLE], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "error: kiras_bridge.py takes a robot and the policy file that runs\n"
