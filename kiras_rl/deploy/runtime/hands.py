"""What an operator holds: gamepad, keyboard, the robot's own remote, or a script; maps are data."""

from __future__ import annotations

import os
import select
import struct
import sys
import termios
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from kiras_rl.deploy.joystick import AXIS, BUTTON, DEVICES, FULL, Joystick
from kiras_rl.deploy.metadata import PolicyMetadata
from kiras_rl.deploy.runtime.messages import NANO, WISH, Request

DEAD = 0.12  # of a stick's full deflection: where sticks come to rest

HANDOVER = 2.0  # s that a hand's own sticks rest before a guest's velocities count
FORGOTTEN = 0.25  # s that a guest's velocities count

# What a button or key does: a request, or one of these.
EMERGENCY, HELD, NEXT, PREVIOUS, STOP = "emergency", "held", "next", "previous", "stop"
FORWARD, LEFT, TURN = range(3)

# Buttons, and axes with the sign that counts, by the numbers of Linux's xpad driver.
GAMEPAD_BUTTONS = {
    0: Request.STAND,  # A
    1: EMERGENCY,  # B
    2: Request.WALK,  # X
    3: Request.LIE,  # Y
    5: HELD,  # RB
    6: Request.SAVE,  # Back
    7: Request.ACKNOWLEDGE,  # Start
}
GAMEPAD_STICKS = {1: (FORWARD, -1.0), 0: (LEFT, -1.0), 3: (TURN, -1.0)}
GAMEPAD_HAT = 6  # the cross, left and right: the skill before, the next skill

# Bits of the Go1's remote, joystick.h of unitree_legged_sdk 3.8. B is also part of L2+B, with which
# the maker's own controller damps.
REMOTE_BUTTONS = {
    0: HELD,  # R1
    2: Request.ACKNOWLEDGE,  # start
    3: Request.SAVE,  # select
    8: Request.STAND,  # A
    9: EMERGENCY,  # B
    10: Request.WALK,  # X
    11: Request.LIE,  # Y
    13: NEXT,  # right
    15: PREVIOUS,  # left
}
_REMOTE = struct.Struct("<2xH5f")  # head, buttons, then lx, rx, ry, L2, ly

KEYS = {
    " ": EMERGENCY,
    "o": Request.ACKNOWLEDGE,
    "u": Request.STAND,
    "p": Request.WALK,
    "l": Request.LIE,
    "b": Request.SAVE,
    "x": STOP,
}
KEY_STEPS = {  # a press changes the command by so much, m/s and rad/s
    "w": (FORWARD, 0.1),
    "s": (FORWARD, -0.1),
    "q": (LEFT, 0.1),
    "e": (LEFT, -0.1),
    "a": (TURN, 0.2),
    "d": (TURN, -0.2),
}
KEY_HELP = (
    "o motors on   u stand up   p policy   l lie down   SPACE emergency stop   b black box\n"
    "1..9 skill   w s faster, slower   a d turn   q e sideways   x stop   Ctrl-C lie down, leave"
)
PAD_HELP = (
    "Start motors on   A stand up   X policy   Y lie down   B emergency stop   Back black box\n"
    "cross skill   left stick drives   right stick turns   Ctrl-C lie down, leave"
)


class Hand:
    """Collects what devices do into the wish that the runtime reads."""

    def __init__(self, metadata: PolicyMetadata) -> None:
        """Hold nothing yet: no command, the first skill."""
        ranges = metadata.command_range
        self._range = np.array([ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_z])
        self._skills = len(metadata.skills)
        self._wish = np.zeros((), WISH)
        self._command, self._steered = np.zeros(3), 0  # and when it was last not zero, ns
        self._down: set[object] = set()

    @property
    def skill(self) -> int:
        """Index of the skill that is chosen."""
        return int(self._wish["skill"])

    def press(self, action: object) -> None:
        """Do what a button does."""
        if isinstance(action, Request):
            self._wish["request"] = action
            self._wish["requests"] += 1
        elif action in (NEXT, PREVIOUS):
            step = 1 if action == NEXT else -1
            self.choose((self.skill + step) % self._skills)
        elif action == STOP:
            self._command[:] = 0.0

    def hold(self, action: object, down: bool) -> None:
        """Remember whether a button that counts as long as it is held is down."""
        (self._down.add if down else self._down.discard)(action)

    def choose(self, skill: int) -> None:
        """Choose a skill by its index; an index that is none changes nothing."""
        if 0 <= skill < self._skills:
            self._wish["skill"] = skill

    def steer(self, axis: int, share: float) -> None:
        """Set an axis of the command to a share, -1 to 1, of its range."""
        low, high = self._range[axis]
        self._command[axis] = share * (high if share > 0 else -low)

    def nudge(self, axis: int, step: float) -> None:
        """Change an axis of the command, m/s or rad/s."""
        self._command[axis] = np.clip(self._command[axis] + step, *self._range[axis])

    def set_command(self, command: Sequence[float]) -> None:
        """Set the whole command: v_x, v_y in m/s, yaw rate in rad/s."""
        self._command[:] = command

    def wish(self, now: int, connected: bool, guest: np.ndarray | None = None) -> np.ndarray:
        """Return the WISH of a moment, shape ().

        Args:
            now: ns.
            connected: Whether there is something in the hand.
            guest: The newest GUEST, whose velocities count while the hand's own have been zero for
                HANDOVER; None if there is none.
        """
        wish = self._wish
        wish["seq"] += 1
        wish["time"], wish["connected"] = now, connected
        wish["emergency"], wish["held"] = EMERGENCY in self._down, HELD in self._down
        wish["command"] = self._command if connected else 0.0
        if connected and guest is not None and self._rests(now):
            age = (now - int(guest["time"])) / NANO
            if 0 <= age <= FORGOTTEN and np.isfinite(guest["command"]).all():
                wish["command"] = guest["command"]
        return wish

    def _rests(self, now: int) -> bool:
        if self._command.any():
            self._steered = now
        return now - self._steered > HANDOVER * NANO


class Gamepad:
    """The first joystick of /dev/input; it may come and go."""

    help = PAD_HELP

    def __init__(self, devices: Path = DEVICES) -> None:
        """Look for a pad in a folder of devices."""
        self._stick = Joystick(devices)

    def poll(self, hand: Hand, now: int) -> bool:
        """Tell the hand what has happened, and return whether there is a pad."""
        before, events = self._stick.connected, self._stick.events()
        if events is None:
            if before:  # pulled out: nobody holds the sticks
                hand.press(STOP)
                hand.hold(HELD, False)
            return False
        for event in events:
            self._take(hand, *event)
        return True

    def _take(self, hand: Hand, value: int, kind: int, number: int) -> None:
        if kind == AXIS and number in GAMEPAD_STICKS:
            axis, sign = GAMEPAD_STICKS[number]
            share = value / FULL
            hand.steer(axis, sign * share if abs(share) > DEAD else 0.0)
        elif kind == AXIS and number == GAMEPAD_HAT and value:
            hand.press(NEXT if value > 0 else PREVIOUS)
        elif kind == BUTTON and number in GAMEPAD_BUTTONS:
            _change(hand, GAMEPAD_BUTTONS[number], bool(value))


class Remote:
    """The robot's own remote, out of the readings."""

    help = PAD_HELP

    def __init__(self) -> None:
        """Begin with no button down."""
        self._before = 0

    def take(self, hand: Hand, remote: bytes) -> bool:
        """Tell the hand what the remote's 40 bytes say; return whether it is on."""
        if not any(remote):
            return False
        buttons, lx, rx, _, _, ly = _REMOTE.unpack_from(remote)
        for bit, action in REMOTE_BUTTONS.items():
            if (buttons ^ self._before) >> bit & 1:
                _change(hand, action, bool(buttons >> bit & 1))
        self._before = buttons
        for axis, share in ((FORWARD, ly), (LEFT, -lx), (TURN, -rx)):
            hand.steer(axis, share if DEAD < abs(share) <= 1.0 else 0.0)
        return True


def remote_emergency(remote: bytes) -> bool:
    """Tell whether the remote's emergency button is down."""
    (buttons,) = struct.unpack_from("<H", remote, 2)
    return any(buttons >> bit & 1 for bit, act in REMOTE_BUTTONS.items() if act == EMERGENCY)


class Keyboard:
    """The keys of the terminal that kiras-robot runs in; use it as a context."""

    help = KEY_HELP

    def __init__(self, file: int | None = None) -> None:
        """Take a terminal, standard input if none is given."""
        self._file = sys.stdin.fileno() if file is None else file
        self._before: list | None = None
        self._pressed = 0
        self._open = True

    def __enter__(self) -> Keyboard:
        """Read keys one by one, without echo."""
        if os.isatty(self._file):
            self._before = termios.tcgetattr(self._file)
            quiet = termios.tcgetattr(self._file)
            quiet[3] &= ~(termios.ICANON | termios.ECHO)
            termios.tcsetattr(self._file, termios.TCSANOW, quiet)
        return self

    def __exit__(self, *error: object) -> None:
        """Leave the terminal as it was."""
        if self._before is not None:
            termios.tcsetattr(self._file, termios.TCSANOW, self._before)

    def poll(self, hand: Hand, now: int) -> bool:
        """Tell the hand which keys were pressed; return whether the terminal is still there."""
        if now - self._pressed > 0.2 * NANO:
            hand.hold(EMERGENCY, False)
        hand.hold(HELD, True)  # a terminal does not tell when a key is let go
        while self._open and select.select([self._file], [], [], 0)[0]:
            keys = os.read(self._file, 64).decode("ascii", "ignore").lower()
            self._open = bool(keys)
            for key in keys:
                self._press(hand, key, now)
        return self._open

    def _press(self, hand: Hand, key: str, now: int) -> None:
        action = KEYS.get(key)
        if action == EMERGENCY:
            hand.hold(EMERGENCY, True)
            self._pressed = now
        elif action is not None:
            hand.press(action)
        elif key in KEY_STEPS:
            hand.nudge(*KEY_STEPS[key])
        elif key.isdigit():
            hand.choose(int(key) - 1)


def _change(hand: Hand, action: object, down: bool) -> None:
    """Pass on a button that went down or up."""
    if action in (EMERGENCY, HELD):
        hand.hold(action, down)
    elif down:
        hand.press(action)
