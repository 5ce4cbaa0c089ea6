"""Slow moves of the joints from wherever they are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

SPEED = 1.0  # rad/s, the fastest that a joint moves
SHORTEST = 1.0  # s, a move however short
_PEAK = 1.875  # largest speed of a minimum-jerk move over its mean one: the quintic's slope halfway


class Path:
    """Joint targets through a row of poses, with minimum jerk between each two.

    The quintic 10 s^3 - 15 s^4 + 6 s^5 (Flash and Hogan 1985, equation 6) begins and ends at rest.
    """

    def __init__(self, poses: Sequence[np.ndarray]) -> None:
        """Take the poses, (J,) each, rad; the first one is where the joints are."""
        self._poses = [np.asarray(pose, np.float64) for pose in poses]
        steps = [np.abs(after - before).max() for before, after in self._pairs()]
        times = [max(SHORTEST, _PEAK * step / SPEED) for step in steps]
        self._ends = np.cumsum([0.0, *times])

    @property
    def duration(self) -> float:
        """How long it takes, s."""
        return float(self._ends[-1])

    def at(self, time: float) -> np.ndarray:
        """Return the targets at a time from the start, s; the last pose from then on. (J,), rad."""
        part = int(np.clip(np.searchsorted(self._ends, time, "right") - 1, 0, len(self._poses) - 2))
        length = self._ends[part + 1] - self._ends[part]
        share = np.clip((time - self._ends[part]) / length, 0.0, 1.0)
        smooth = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        before, after = self._poses[part], self._poses[part + 1]
        return before + smooth * (after - before)

    def _pairs(self) -> list[tuple[np.ndarray, np.ndarray]]:
        return [(self._poses[i], self._poses[i + 1]) for i in range(len(self._poses) - 1)]
