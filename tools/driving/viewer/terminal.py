"""The drive in a terminal: keys and numbers, for machines without a browser."""

from __future__ import annotations

import contextlib
import curses
import sys
import time
from collections.abc import Iterator

import numpy as np

from kiras_rl.tools.driving.viewer import LiveError, bindings
from kiras_rl.tools.driving.viewer.cockpit import AXES, FORWARD, YAW, Cockpit
from kiras_rl.tools.driving.viewer.view import View

_HOLD = {FORWARD: 0.08, YAW: 0.6}  # s that a key counts as held: its repetition starts after 0.5
_FRAME = 0.1  # s between pictures
_ARROWS = {
    curses.KEY_UP: "Up",
    curses.KEY_DOWN: "Down",
    curses.KEY_LEFT: "Left",
    curses.KEY_RIGHT: "Right",
}
_LEAVE = "X"
_BAR = 30  # characters


class TerminalError(LiveError):
    """There is no terminal to draw in."""


class Terminal:
    """Draws a cockpit with characters, and reads its keys; used within `open_screen`."""

    def __init__(self, screen: curses.window, cockpit: Cockpit, view: View) -> None:
        """Take over a screen."""
        self._screen, self._cockpit, self._view = screen, cockpit, view
        self._drawn = 0.0
        self.leaving = False
        screen.nodelay(True)
        with contextlib.suppress(curses.error):  # terminals that cannot hide it
            curses.curs_set(0)

    def refresh(self) -> None:
        """Read the keys, and draw if the last picture is old."""
        while (code := self._screen.getch()) != curses.ERR:
            self._press(_name(code))
        if time.monotonic() - self._drawn > _FRAME:
            self._drawn = time.monotonic()
            self._draw()

    def _press(self, key: str) -> None:
        if key == _LEAVE:
            self.leaving = True
        elif key in bindings.HELD:
            axis, direction = bindings.HELD[key]
            self._cockpit.post(self._cockpit.hold, axis, direction, _HOLD.get(axis, 0.6))
        else:
            bindings.press(self._cockpit, key)

    def _draw(self) -> None:
        self._screen.erase()
        height, width = self._screen.getmaxyx()
        for row, line in enumerate(lines(self._cockpit, self._view)[: height - 1]):
            self._screen.addnstr(row, 0, line, width - 1)
        self._screen.refresh()


@contextlib.contextmanager
def open_screen() -> Iterator[curses.window]:
    """Turn the terminal into a screen, and back.

    Raises:
        TerminalError: If there is none.
    """
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise TerminalError("--terminal needs a terminal; here input or output is something else")
    try:
        screen = curses.initscr()
    except curses.error as error:
        raise TerminalError(f"--terminal cannot use this terminal: {error}") from None
    try:
        curses.noecho()
        curses.cbreak()
        screen.keypad(True)
        yield screen
    finally:
        curses.endwin()


def lines(cockpit: Cockpit, view: View) -> list[str]:
    """Describe a cockpit, one text a line."""
    kept = cockpit.telemetry.view()
    state = "paused" if cockpit.paused else f"speed {cockpit.speed:g} x"
    skills = "   ".join(
        f"[{i + 1} {name}]" if i == cockpit.skill else f" {i + 1} {name} "
        for i, name in enumerate(cockpit.skills)
    )
    text = [f"{cockpit.title}   terrain {cockpit.tile}", "", skills, ""]
    text += [
        f"{AXES[axis]:>14} {_bar(cockpit.target[axis], cockpit.limits[axis])} "
        f"{cockpit.target[axis]:+.2f}"
        for axis in range(3)
        if cockpit.limits[axis][0] < cockpit.limits[axis][1]
    ]
    if len(kept["time"]):
        last = {name: float(column[-1]) for name, column in kept.items()}
        text += ["", f"{'':14} {'is':>8} {'target':>8}", *_rows(last)]
    crossings = "" if cockpit.tile.is_flat else f"   crossed {cockpit.crossings}"
    counts = f"falls {cockpit.falls}{crossings}"
    text += ["", f"{state}   real time {view.real_time:.2f} x   {counts}"]
    return [*text, cockpit.notice, "", *bindings.HELP, "X leave"]


def _rows(last: dict[str, float]) -> list[str]:
    degrees = float(np.rad2deg(1))
    rows = [
        f"{'height, cm':>14} {100 * last['base_height']:8.1f} {100 * last['target_height']:8.1f}",
        f"{'pitch, deg':>14} {degrees * last['pitch']:8.1f} {degrees * last['target_pitch']:8.1f}",
        f"{'v_x, m/s':>14} {last['lin_vel_x']:8.2f} {last['command_x']:8.2f}",
        f"{'yaw, rad/s':>14} {last['yaw_rate']:8.2f} {last['command_yaw']:8.2f}",
    ]
    if np.isfinite(last["estimate_x"]):
        rows.insert(3, f"{'estimated v_x':>14} {last['estimate_x']:8.2f}")
    return rows


def _bar(value: float, limits: np.ndarray) -> str:
    low, high = limits
    place = round((value - low) / (high - low) * (_BAR - 1))
    return "".join("#" if i == place else "-" for i in range(_BAR))


def _name(code: int) -> str:
    """Return what `bindings` calls a key."""
    if code in _ARROWS:
        return _ARROWS[code]
    character = chr(code).upper() if 0 <= code < 128 else ""
    return "Space" if character == " " else character
