"""The last seconds of a drive, for plots."""

from __future__ import annotations

import threading

import numpy as np

from kiras_rl.deploy.metadata import Posture
from kiras_rl.tools.driving.driver import Sample

COLUMNS = (
    *("time", "base_height", "target_height", "pitch", "target_pitch"),
    *("lin_vel_x", "command_x", "estimate_x", "yaw_rate", "command_yaw"),
)
"""What is kept of every control step: s, m, rad, m/s and rad/s."""


class Telemetry:
    """A ring of the last samples, written by the simulation and read by whoever draws it."""

    def __init__(self, rate: float, seconds: float = 8.0) -> None:
        """Make room.

        Args:
            rate: Samples a second.
            seconds: How much is kept.
        """
        self.seconds = seconds
        self._rows = np.full((round(rate * seconds), len(COLUMNS)), np.nan)
        self._count = 0
        self._lock = threading.Lock()

    def add(self, sample: Sample, posture: Posture, velocity: np.ndarray) -> None:
        """Keep one sample.

        Args:
            sample: What happened.
            posture: What was asked for.
            velocity: The policy's estimate of the base velocity, (3,), m/s; exactly zero is what
                a policy without an estimator gives, and is kept as "none".
        """
        estimate = velocity[0] if velocity.any() else np.nan
        row = (
            *(sample.time, sample.base_height, posture.base_height, sample.pitch, posture.pitch),
            *(sample.lin_vel[0], sample.command[0], estimate),
            *(sample.yaw_rate, sample.command[2]),
        )
        with self._lock:
            self._rows[self._count % len(self._rows)] = row
            self._count += 1

    def clear(self) -> None:
        """Forget all samples."""
        with self._lock:
            self._count = 0

    def view(self) -> dict[str, np.ndarray]:
        """Copy what is kept: a column for each name of `COLUMNS`, (T,), oldest first."""
        with self._lock:
            if self._count < len(self._rows):
                rows = self._rows[: self._count].copy()
            else:
                rows = np.roll(self._rows, -(self._count % len(self._rows)), axis=0)
        return dict(zip(COLUMNS, rows.T, strict=True))
