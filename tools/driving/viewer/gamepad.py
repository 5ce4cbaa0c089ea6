"""A gamepad at the machine that simulates, read from Linux's joystick device: no package needed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from kiras_rl.deploy.joystick import AXIS, BUTTON, DEVICES, FULL, Joystick
from kiras_rl.tools.driving.viewer.cockpit import FORWARD, LEFT, YAW, Cockpit

NAMES = "left stick drives, right stick turns, A push, X reset, LB RB skills, Start pause"

_DEAD = 0.12  # of the full deflection: where sticks come to rest
# numbers of the kernel's xpad driver, which most pads speak
_LEFT_X, _LEFT_Y, _RIGHT_X = 0, 1, 3
_A, _X, _LB, _RB, _START = 0, 2, 4, 5, 7


class Gamepad:
    """Reads the first joystick and posts what it says; a pad may come and go."""

    def __init__(self, cockpit: Cockpit, devices: Path = DEVICES) -> None:
        """Look for a pad in a folder of devices."""
        self._cockpit = cockpit
        self._stick = Joystick(devices, every=100)  # two seconds of a control loop
        self._axes: dict[int, float] = {}
        self._moved = False

    @property
    def connected(self) -> bool:
        """Whether there is one."""
        return self._stick.connected

    def poll(self) -> None:
        """Read what has happened since the last call."""
        events = self._stick.events()
        if events is None:
            self._axes = {}  # pulled out: nobody holds the stick
        for event in events or ():
            self._take(*event)
        self._steer()

    def close(self) -> None:
        """Let go of the device."""
        self._stick.close()
        self._axes = {}

    def _take(self, value: int, kind: int, number: int) -> None:
        if kind == AXIS:  # what an axis says before it moves may be a rest at one of its ends
            share = value / FULL
            self._axes[number] = share if abs(share) > _DEAD else 0.0
        elif kind == BUTTON and value:
            self._press(number)

    def _press(self, button: int) -> None:
        cockpit = self._cockpit
        actions: dict[int, Callable[[], None]] = {
            _A: cockpit.push,
            _X: cockpit.reset,
            _START: cockpit.toggle_pause,
            _LB: lambda: cockpit.choose_skill((cockpit.skill - 1) % len(cockpit.skills)),
            _RB: lambda: cockpit.choose_skill((cockpit.skill + 1) % len(cockpit.skills)),
        }
        if button in actions:
            cockpit.post(actions[button])

    def _steer(self) -> None:
        """Give the sticks' deflection to the axes, and once more when they are let go."""
        sideways = self._cockpit.limits[LEFT].any()
        left, turn = self._axes.get(_LEFT_X, 0.0), self._axes.get(_RIGHT_X, 0.0)
        shares = {
            FORWARD: -self._axes.get(_LEFT_Y, 0.0),
            LEFT: -left if sideways else 0.0,
            YAW: -turn if sideways or turn else -left,
        }
        moving = any(shares.values())
        if moving or self._moved:
            for axis, share in shares.items():
                self._cockpit.post(self._cockpit.set_share, axis, share)
        self._moved = moving
