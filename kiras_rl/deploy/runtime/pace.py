"""How punctual a loop is, in memory that does not grow."""

from __future__ import annotations

import numpy as np

BIN = 10_000  # ns
BINS = 10_000  # up to 0.1 s; later is counted there


class Pace:
    """Counts by how much ticks come late.

    Attributes:
        worst: The latest tick, ns.
        misses: Ticks later than half a period.
    """

    def __init__(self, period: int) -> None:
        """Begin to count, for a period in ns."""
        self._period = period
        self._counts = np.zeros(BINS, np.int64)
        self.worst = self.misses = 0

    def add(self, late: int) -> None:
        """Count a tick that came late by so many ns."""
        self._counts[min(max(late, 0) // BIN, BINS - 1)] += 1
        self.worst = max(self.worst, late)
        self.misses += late > self._period // 2

    @property
    def ticks(self) -> int:
        """How many were counted."""
        return int(self._counts.sum())

    def quantile(self, share: float) -> float:
        """Return the lateness that a share of the ticks kept, ms, rounded up to a bin."""
        index = int(np.searchsorted(np.cumsum(self._counts), share * max(self.ticks, 1)))
        return (index + 1) * BIN / 1e6

    def line(self) -> str:
        """Say it in a line."""
        return (
            f"{self.ticks} ticks late by p50 {self.quantile(0.5):.2f}, "
            f"p99 {self.quantile(0.99):.2f}, max {self.worst / 1e6:.2f} ms; {self.misses} misses"
        )
