"""How punctual a loop is, in memory that does not grow."""

from __future__ import annotations

import numpy as np

BIN = 10_000  # ns
BINS = 10_000  # up to 0.1 s; longer is counted there


class Times:
    """Counts durations.

    Attributes:
        largest: The longest one, ns.
    """

    def __init__(self) -> None:
        """Begin with none."""
        self._counts = np.zeros(BINS, np.int64)
        self.largest = 0

    def add(self, duration: int) -> None:
        """Count one, ns; what is negative counts as nothing."""
        self._counts[min(max(duration, 0) // BIN, BINS - 1)] += 1
        self.largest = max(self.largest, duration)

    @property
    def count(self) -> int:
        """How many there were."""
        return int(self._counts.sum())

    def quantile(self, share: float) -> float:
        """Return what a share of them kept, ms, rounded up to a bin."""
        index = int(np.searchsorted(np.cumsum(self._counts), share * max(self.count, 1)))
        return (index + 1) * BIN / 1e6

    def line(self) -> str:
        """Say p50, p99 and maximum in ms."""
        p50, p99 = self.quantile(0.5), self.quantile(0.99)
        return f"p50 {p50:.2f}, p99 {p99:.2f}, max {self.largest / 1e6:.2f} ms"


class Pace:
    """Counts how late ticks come, and how long after the one before.

    A tick that itself takes too long shows in the periods alone: the next one is then due at once.

    Attributes:
        late: Behind the moment that was due.
        periods: Between the beginnings of two ticks.
        misses: Ticks later than half a period, or longer than one and a half after the one before.
    """

    def __init__(self, period: int) -> None:
        """Begin to count, for a period in ns."""
        self._period = period
        self.late, self.periods = Times(), Times()
        self.misses = 0

    def add(self, late: int, since: int) -> None:
        """Count a tick.

        Args:
            late: Behind its moment, ns.
            since: After the tick before, ns.
        """
        self.late.add(late)
        self.periods.add(since)
        self.misses += 2 * late > self._period or 2 * since > 3 * self._period

    @property
    def ticks(self) -> int:
        """How many were counted."""
        return self.late.count

    def line(self) -> str:
        """Say it in a line."""
        return (
            f"{self.ticks} ticks late by {self.late.line()}; "
            f"periods {self.periods.line()}; {self.misses} misses"
        )
