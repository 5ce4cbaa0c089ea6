"""Real time, kept in one place."""

from __future__ import annotations

import time
from collections.abc import Callable

_FORGIVEN = 0.25  # s behind that are caught up; more is dropped, or the robot would race
_WINDOW = 2.0  # s over which the real-time factor is taken


class Clock:
    """Lets a loop wait for the moments that it asks for, one after the other.

    Attributes:
        real_time: Seconds asked for in a second of the world, over the last window; 1 is on time.
    """

    def __init__(
        self,
        now: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Start now.

        Args:
            now: Returns the time, s.
            sleep: Waits for some s.
        """
        self._now, self._sleep = now, sleep
        self.real_time = 1.0
        self._due = self._start = now()
        self._asked = 0.0

    def wait(self, seconds: float) -> None:
        """Wait until so long after the moment that the last call waited for."""
        self._due += seconds
        left = self._due - self._now()
        if left > 0:
            self._sleep(left)
        elif left < -_FORGIVEN:
            self._due = self._now()
        self._measure(seconds)

    def _measure(self, seconds: float) -> None:
        self._asked += seconds
        elapsed = self._now() - self._start
        if elapsed >= _WINDOW:
            self.real_time = self._asked / elapsed
            self._start, self._asked = self._now(), 0.0
