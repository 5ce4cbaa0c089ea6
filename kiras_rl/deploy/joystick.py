"""Linux's joystick device: no package needed."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import NamedTuple

DEVICES = Path("/dev/input")
BUTTON, AXIS = 0x01, 0x02
FIRST = 0x80  # added to the kind in what the kernel tells of a joystick when it opens
FULL = 32767  # an axis at its end

# struct js_event of linux/joystick.h: time in ms, value, type, number
_EVENT = struct.Struct("<IhBB")


class Event(NamedTuple):
    """A button or an axis that changed."""

    value: int
    """1 or 0 of a button, -FULL to FULL of an axis."""
    kind: int
    """BUTTON or AXIS, and FIRST."""
    number: int
    """Which one."""


class Joystick:
    """The first joystick of a machine; it may come and go."""

    def __init__(self, devices: Path = DEVICES, every: int = 50) -> None:
        """Look for one in a folder of devices, at every so many calls while there is none."""
        self._devices, self._every = devices, every
        self._file: int | None = None
        self._calls = 0

    @property
    def connected(self) -> bool:
        """Whether there is one."""
        return self._file is not None

    def events(self) -> list[Event] | None:
        """Return what has happened since the last call, None if there is no joystick any more."""
        if self._file is None:
            if self._calls % self._every == 0:
                self._open()
            self._calls += 1
        if self._file is None:
            return None
        events = []
        try:
            while len(data := os.read(self._file, _EVENT.size)) == _EVENT.size:
                events.append(Event(*_EVENT.unpack(data)[1:]))
        except BlockingIOError:
            return events
        except OSError:
            pass
        self.close()  # pulled out
        return None

    def close(self) -> None:
        """Let go of the device."""
        if self._file is not None:
            os.close(self._file)
        self._file = None

    def _open(self) -> None:
        for path in sorted(self._devices.glob("js*")):
            try:
                self._file = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
            except OSError:  # not ours to read
                continue
            return
