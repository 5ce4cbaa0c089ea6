"""The driver's loop: measurements out, orders in, and the deadline between."""

from __future__ import annotations

import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path

import numpy as np

from kiras_rl.deploy.errors import PlainError
from kiras_rl.deploy.runtime.blackbox import Ring
from kiras_rl.deploy.runtime.guard import Guard
from kiras_rl.deploy.runtime.mailbox import SHARED, Mailbox, Seat
from kiras_rl.deploy.runtime.messages import (
    GUEST,
    NANO,
    ORDER,
    READING,
    WISH,
    Flag,
    Mode,
    make_reading,
)
from kiras_rl.deploy.runtime.pace import Pace

ALONE = 30.0  # s that a driver goes on damping after its runtime has ended
SPIN = 0.0001  # s before a deadline that are waited for awake: the kernel wakes later than asked


class LinkError(PlainError, RuntimeError):
    """The robot cannot be reached, or is in a state in which it takes no orders."""


class Link(ABC):
    """A robot's electronics."""

    @abstractmethod
    def receive(self, reading: np.ndarray, now: int) -> bool:
        """Write the newest measurement into a READING, and return whether there was a new one.

        The link sets everything but seq, time, order and mode, and only the flags it knows of.

        Args:
            reading: To write into, shape ().
            now: ns.
        """

    @abstractmethod
    def send(self, mode: Mode, order: np.ndarray, now: int) -> None:
        """Tell the motors what to do.

        Args:
            mode: What to do.
            order: With targets and gains for Mode.SERVO and Mode.HOLD, shape ().
            now: ns.
        """

    def close(self) -> None:  # noqa: B027, most links have nothing to close
        """Let go of the robot; the motors are damped by then."""


class Channel:
    """The mailboxes, seats and ring of one robot on this computer."""

    def __init__(self, name: str, root: Path = SHARED) -> None:
        """Open what is there, or make it.

        Args:
            name: Of the channel; a robot's name.
            root: Folder in memory.
        """
        self.folder = root / f"kiras-robot-{os.getuid()}-{name}"
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.readings = Mailbox(self.folder / "readings", READING)
        self.orders = Mailbox(self.folder / "orders", ORDER)
        self.wishes = Mailbox(self.folder / "wishes", WISH)
        self.guests = Mailbox(self.folder / "guests", GUEST)
        self.driver = Seat(self.folder / "driver.seat")
        self.runtime = Seat(self.folder / "runtime.seat")
        self.operator = Seat(self.folder / "operator.seat")

    @property
    def ring(self) -> Path:
        """The black box's file."""
        return self.folder / "ring"


class Driver:
    """One robot behind its link, at its rate; `tick` does one period."""

    def __init__(
        self, link: Link, channel: Channel, ring: Ring, log: Callable[[str], object]
    ) -> None:
        """Take over a link.

        Args:
            link: The robot.
            channel: Where readings go and orders come from.
            ring: The black box.
            log: Takes a line whenever the driver itself begins or ceases to damp.
        """
        self._link, self._channel, self._ring, self._log = link, channel, ring, log
        self._guard = Guard()
        self._reading = make_reading()
        self._alive = True
        self.mode = Mode.OFF

    @property
    def reason(self) -> str:
        """Why the driver itself damps; empty while it does not."""
        return self._guard.reason

    def tick(self, now: int) -> None:
        """Receive, judge, send, publish.

        Args:
            now: ns.
        """
        reading = self._reading
        if self._link.receive(reading, now):
            reading["seq"] += 1
            reading["time"] = now
        wish = self._channel.wishes.get()
        pressed = bool(int(reading["flags"]) & Flag.EMERGENCY)
        emergency = pressed or (wish is not None and bool(wish["emergency"]))
        self._alive = self._channel.runtime.is_taken()
        self._judge(now, emergency)
        order = self._guard.order
        self._link.send(self.mode, order, now)
        reading["mode"], reading["order"] = self.mode, order["seq"]
        flags = int(reading["flags"]) & ~int(Flag.LATCHED)
        reading["flags"] = flags | (Flag.LATCHED if self._guard.reason else 0)
        self._channel.readings.put(reading)
        self._ring.append(reading, order)

    def _judge(self, now: int, emergency: bool) -> None:
        before, reason = self.mode, self._guard.reason
        self.mode = self._guard.decide(self._channel.orders.get(), now, self._alive, emergency)
        if self._guard.reason and not reason:
            self._log(f"damps by itself: {self._guard.reason}")
        elif reason and not self._guard.reason:
            self._log("follows the runtime again")
        elif self.mode == Mode.HOLD and before != Mode.HOLD:
            self._log("holds: the order has run out")

    def run(self, rate: float, is_over: Callable[[], bool]) -> Pace:
        """Tick at a rate until told to end, or until the runtime has been gone for ALONE.

        Args:
            rate: Hz.
            is_over: Whether to end.

        Returns:
            How punctual it was.
        """
        seen = time.monotonic_ns()

        def tick(now: int) -> bool:
            nonlocal seen
            self.tick(now)
            seen = now if self._alive else seen
            return is_over() or now - seen > ALONE * NANO

        return keep_pace(tick, rate)


def keep_pace(tick: Callable[[int], bool], rate: float) -> Pace:
    """Call a function at a rate, with the time in ns, until it says that it is over.

    A period that is missed is left out: two at once would be of one moment.

    Args:
        tick: To call.
        rate: Hz.

    Returns:
        How punctual it was.
    """
    period = round(NANO / rate)
    pace = Pace(period)
    due = now = time.monotonic_ns()
    while not tick(now):
        due = max(due + period, time.monotonic_ns() - period)
        _sleep_until(due)
        before, now = now, time.monotonic_ns()
        pace.add(now - due, now - before)
    return pace


def _sleep_until(due: int) -> None:
    """Sleep until a moment of the monotonic clock, ns, the last bit of it awake."""
    left = (due - time.monotonic_ns()) / NANO
    if left > SPIN:
        time.sleep(left - SPIN)
    while time.monotonic_ns() < due:
        pass
