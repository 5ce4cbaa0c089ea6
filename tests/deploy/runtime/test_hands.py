"""Devices by the bytes that the kernel, a terminal or a robot's remote would give."""

from __future__ import annotations

import os
import struct

import numpy as np
import pytest

from kiras_rl.deploy.runtime.hands import Gamepad, Hand, Keyboard, Remote, remote_emergency
from kiras_rl.deploy.runtime.messages import GUEST, NANO, Request, State
from kiras_rl.deploy.runtime.scripts import ScriptError, parse_script

A, B, X, Y, RB, START = 0, 1, 2, 3, 5, 7
AXIS, BUTTON = 2, 1


@pytest.fixture
def metadata(make_metadata):
    return make_metadata()  # v_x -0.3 to 0.6 m/s, no v_y, yaw -0.6 to 0.6 rad/s


@pytest.fixture
def hand(metadata):
    return Hand(metadata)


class Pad:
    """A named pipe in the place of /dev/input/js0."""

    def __init__(self, folder):
        self.path = folder / "js0"
        os.mkfifo(self.path)
        self.pad = Gamepad(folder)
        self.end = None

    def plug(self, hand):
        self.end = os.open(self.path, os.O_RDWR)  # of a pipe: does not wait for a reader
        assert self.pad.poll(hand, 0)

    def say(self, hand, kind, number, value):
        os.write(self.end, struct.pack("<IhBB", 0, value, kind, number))
        return self.pad.poll(hand, 0)


def test_a_gamepad_s_sticks_are_shares_of_the_range(tmp_path, hand):
    pad = Pad(tmp_path)
    pad.plug(hand)
    assert pad.say(hand, AXIS, 1, -32767)  # forward: the kernel counts down
    assert hand.wish(1, True)["command"] == pytest.approx([0.6, 0.0, 0.0])
    pad.say(hand, AXIS, 1, 32767)
    pad.say(hand, AXIS, 3, -16384)  # half to the left
    assert hand.wish(2, True)["command"] == pytest.approx([-0.3, 0.0, 0.3], abs=1e-4)
    pad.say(hand, AXIS, 1, 3000)  # where sticks come to rest
    assert hand.wish(3, True)["command"][0] == 0.0


def guest_says(time, command):
    guest = np.zeros((), GUEST)
    guest["time"], guest["command"] = time, command
    return guest


def test_a_guest_steers_while_the_hand_rests(hand):
    start = 10 * NANO
    assert hand.wish(start, True, guest_says(start, (0.2, 0.0, 0.1)))["command"] == pytest.approx(
        [0.2, 0.0, 0.1]
    )
    hand.set_command((0.5, 0.0, 0.0))
    assert hand.wish(start, True, guest_says(start, (0.2, 0.0, 0.1)))["command"][0] == 0.5
    hand.set_command((0.0, 0.0, 0.0))
    for seconds, expected in ((0.1, 0.0), (1.9, 0.0), (2.1, 0.2)):  # HANDOVER is 2 s
        now = start + round(seconds * NANO)
        wish = hand.wish(now, True, guest_says(now, (0.2, 0.0, 0.1)))
        assert wish["command"][0] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("age", "command", "connected"),
    [
        (0.3, (0.2, 0.0, 0.0), True),  # FORGOTTEN is 0.25 s
        (-0.1, (0.2, 0.0, 0.0), True),
        (0.0, (float("nan"), 0.0, 0.0), True),
        (0.0, (0.2, 0.0, 0.0), False),  # nobody is there who could stop it
    ],
)
def test_a_guest_that_does_not_count(hand, age, command, connected):
    now = 10 * NANO
    guest = guest_says(now - round(age * NANO), command)
    assert (hand.wish(now, connected, guest)["command"] == 0.0).all()


def test_a_guest_presses_no_buttons(hand):
    hand.press(Request.LIE)
    wish = hand.wish(10 * NANO, True, guest_says(10 * NANO, (0.2, 0.0, 0.0)))
    assert (wish["request"], wish["requests"], wish["emergency"]) == (Request.LIE, 1, 0)


def test_a_gamepad_s_buttons(tmp_path, hand):
    pad = Pad(tmp_path)
    pad.plug(hand)
    for count, (button, request) in enumerate(
        ((START, Request.ACKNOWLEDGE), (A, Request.STAND), (X, Request.WALK), (Y, Request.LIE)), 1
    ):
        pad.say(hand, BUTTON, button, 1)
        pad.say(hand, BUTTON, button, 0)
        wish = hand.wish(count, True)
        assert (wish["request"], wish["requests"], wish["emergency"]) == (request, count, 0)
    pad.say(hand, BUTTON, B, 1)
    assert hand.wish(9, True)["emergency"] == 1
    pad.say(hand, BUTTON, B, 0)
    assert hand.wish(10, True)["emergency"] == 0
    pad.say(hand, BUTTON, RB, 1)
    assert hand.wish(11, True)["held"] == 1
    pad.say(hand, AXIS, 6, 32767)  # the cross to the right
    assert hand.skill == 1
    pad.say(hand, AXIS, 6, -32767)
    pad.say(hand, AXIS, 6, -32767)
    assert hand.skill == 4


def test_a_gamepad_that_is_pulled_out_holds_nothing(tmp_path, hand):
    pad = Pad(tmp_path)
    pad.plug(hand)
    pad.say(hand, AXIS, 1, -32767)
    pad.say(hand, BUTTON, RB, 1)
    os.close(pad.end)
    assert not pad.pad.poll(hand, 0)
    wish = hand.wish(1, False)
    assert (wish["connected"], wish["held"]) == (0, 0)
    assert not wish["command"].any()


def test_keys_of_a_terminal(hand):
    ours, terminal = os.openpty()
    with Keyboard(terminal) as keyboard:
        os.write(ours, b"o3www")
        assert keyboard.poll(hand, NANO)
        wish = hand.wish(1, True)
        assert (wish["request"], wish["requests"], hand.skill) == (Request.ACKNOWLEDGE, 1, 2)
        assert wish["command"] == pytest.approx([0.3, 0.0, 0.0])
        os.write(ours, b"wwwww7 ")  # there is no seventh skill, and no more than 0.6 m/s
        keyboard.poll(hand, NANO)
        wish = hand.wish(2, True)
        assert (wish["emergency"], hand.skill) == (1, 2)
        assert wish["command"][0] == pytest.approx(0.6)
        keyboard.poll(hand, 2 * NANO)
        assert hand.wish(3, True)["emergency"] == 0
        os.write(ours, b"x")
        keyboard.poll(hand, 2 * NANO)
        assert not hand.wish(4, True)["command"].any()
    os.close(ours)
    os.close(terminal)


def test_an_input_that_has_ended_is_no_operator(hand):
    reader, writer = os.pipe()
    os.close(writer)
    with Keyboard(reader) as keyboard:
        assert not keyboard.poll(hand, NANO)
    os.close(reader)


def remote(buttons=0, lx=0.0, rx=0.0, ry=0.0, l2=0.0, ly=0.0):
    return struct.pack("<2sH5f16x", b"\x55\x51", buttons, lx, rx, ry, l2, ly)


def test_the_remote_of_go1(hand):
    held = Remote()
    assert not held.take(hand, bytes(40))  # off
    assert held.take(hand, remote(1 << 8, ly=1.0, rx=0.5))
    wish = hand.wish(1, True)
    assert (wish["request"], wish["requests"]) == (Request.STAND, 1)
    assert wish["command"] == pytest.approx([0.6, 0.0, -0.3])
    held.take(hand, remote(1 << 8))  # still down
    assert hand.wish(2, True)["requests"] == 1
    assert remote_emergency(remote(1 << 9))
    assert not remote_emergency(remote(1 << 8))


def test_a_script_ends_when_the_robot_is_damped(hand, metadata):
    script = parse_script("on,stand,walk:600", metadata)
    script.follow(State.CONNECTED)
    for second in range(1, 4):
        script.poll(hand, second * NANO)
    script.follow(State.DAMPED)
    for second in range(4, 8):
        script.poll(hand, 2 * second * NANO)
    assert hand.wish(1, True)["request"] == Request.QUIT


@pytest.mark.parametrize("text", ["", "fly", "walk:x", "walk:1:2:3:4:5"])
def test_a_script_that_makes_no_sense_is_one_line(text, metadata):
    with pytest.raises(ScriptError, match="--script: '") as caught:
        parse_script(text, metadata)
    assert "\n" not in str(caught.value)
