"""A gamepad of the host: the kernel's events, from a pipe that stands for the device."""

from __future__ import annotations

import errno
import os
import struct

import pytest

from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.tools.driving.viewer.cockpit import FORWARD, YAW, Cockpit
from kiras_rl.tools.driving.viewer.gamepad import Gamepad

BUTTON, AXIS = 1, 2


class Device:
    """A named pipe in a folder of devices; `send` is what the kernel would do."""

    def __init__(self, folder):
        os.mkfifo(folder / "js0")
        self.file = os.open(folder / "js0", os.O_RDWR)

    def send(self, kind, number, value):
        os.write(self.file, struct.pack("<IhBB", 0, value, kind, number))


@pytest.fixture
def device(tmp_path):
    device = Device(tmp_path)
    yield device
    os.close(device.file)


@pytest.fixture
def cockpit(still_file):
    return Cockpit(OnboardPolicy(still_file))


@pytest.fixture
def pad(cockpit, device, tmp_path):
    pad = Gamepad(cockpit, tmp_path)
    pad.poll()
    assert pad.connected
    yield pad
    pad.close()


def test_without_a_device_nothing_happens(cockpit, tmp_path):
    pad = Gamepad(cockpit, tmp_path)
    pad.poll()
    assert not pad.connected


def test_the_sticks_drive_and_let_go_of_zero(cockpit, device, pad):
    device.send(AXIS, 1, -32767)  # left stick up
    device.send(AXIS, 3, 32767)  # right stick to the right
    pad.poll()
    cockpit.advance()
    assert cockpit.target[FORWARD] == pytest.approx(0.6)
    assert cockpit.target[YAW] == pytest.approx(-0.6)
    device.send(AXIS, 1, 900)  # let go, not quite at zero
    device.send(AXIS, 3, 0)
    pad.poll()
    cockpit.advance()
    assert not cockpit.target.any()


def test_a_pad_that_is_pulled_out_lets_go_of_its_sticks(cockpit, device, pad, monkeypatch):
    device.send(AXIS, 1, -32767)
    pad.poll()
    cockpit.advance()
    assert cockpit.target[FORWARD] > 0

    def gone(file, size):
        raise OSError(errno.ENODEV, "No such device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "read", gone)
        pad.poll()
    assert not pad.connected
    cockpit.advance()
    assert not cockpit.target.any()


def test_a_pad_at_rest_leaves_the_keys_alone(cockpit, pad):
    cockpit.set_target(FORWARD, 0.3)
    pad.poll()
    cockpit.advance()
    assert cockpit.target[FORWARD] == 0.3


def test_an_axis_counts_once_it_has_moved(cockpit, device, pad):
    for axis in range(6):
        device.send(AXIS | 0x80, axis, -32767)  # what the kernel tells when the device is opened
    pad.poll()
    cockpit.advance()
    assert not cockpit.target.any()
    device.send(AXIS, 1, -32767)
    pad.poll()
    cockpit.advance()
    assert cockpit.target[FORWARD] == pytest.approx(0.6)
    assert cockpit.target[YAW] == 0


def test_buttons_change_skills_and_pause(cockpit, device, pad):
    device.send(BUTTON, 5, 1)  # RB, down and up
    device.send(BUTTON, 5, 0)
    pad.poll()
    cockpit.advance()
    assert cockpit.skill == 1
    device.send(BUTTON, 4, 1)
    device.send(BUTTON, 7, 1)
    pad.poll()
    assert cockpit.advance() is None
    assert cockpit.skill == 0
    assert cockpit.paused
