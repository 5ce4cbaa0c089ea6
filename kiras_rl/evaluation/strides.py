"""What walks were like, from records of single robots, whichever simulator they walked in.

Letters: T steps, F feet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

LEAST_SWING = 0.04  # s; a foot that is off the ground for less has not been lifted


@dataclass(frozen=True, eq=False)
class Walk:
    """What one robot did until it fell, or until the end.

    Attributes:
        dt: Time between two steps, s.
        height: Of the base above the ground, (T,), m.
        pitch: Nose down positive, (T,), rad.
        velocity: v_x in the heading frame, (T,), m/s.
        contact: Whether a foot stands, (T, F) bool.
        foot_height: Of the lowest point of each foot above the ground, (T, F), m.
        power: Sum over the joints of |torque * velocity|, (T,), W.
    """

    dt: float
    height: np.ndarray
    pitch: np.ndarray
    velocity: np.ndarray
    contact: np.ndarray
    foot_height: np.ndarray
    power: np.ndarray

    @property
    def duration(self) -> float:
        """Length of the walk, s."""
        return len(self.height) * self.dt

    def thinned(self, every: int) -> Walk:
        """Return the last of every so many steps; a foot stands if it did in any of them."""
        count = len(self.height) // every
        names = ("height", "pitch", "velocity", "foot_height", "power")
        steps = {name: getattr(self, name)[every - 1 :: every][:count] for name in names}
        groups = self.contact[: count * every].reshape(count, every, -1)
        return replace(self, dt=self.dt * every, contact=groups.any(axis=1), **steps)


class Swing(NamedTuple):
    """The steps of a foot in the air, from `start` until before `stop`.

    `has_landed` is False where the record ended first.
    """

    start: int
    stop: int
    has_landed: bool


def swings(contact: np.ndarray, dt: float) -> list[Swing]:
    """Return the swings of a foot that last at least LEAST_SWING.

    A foot that is in the air at the first step has not lifted in this record.

    Args:
        contact: Whether the foot stands, (T,) bool.
        dt: Time between two steps, s.
    """
    changes = np.flatnonzero(contact[1:] != contact[:-1]) + 1
    lifts = changes[~contact[changes]]
    stops = [*changes[contact[changes]], len(contact)]
    found = []
    for start in lifts:
        stop = next(stop for stop in stops if stop > start)
        if stop - start >= round(LEAST_SWING / dt):
            found.append(Swing(int(start), int(stop), stop < len(contact)))
    return found


def describe(walks: Sequence[Walk], height: float, pitch: float) -> dict[str, float | list | None]:
    """Return posture and gait of walks of one skill; None where there is nothing to count.

    Args:
        walks: Of several robots; those without a step are left out.
        height: Of the keyframe, m.
        pitch: Of the keyframe, rad.

    Returns:
        `height` and `pitch`: mean over walks of the time average less the keyframe's, m and rad;
        `height_error` and `pitch_error`: mean of its absolute value. `velocity`: mean v_x, m/s.
        `lifts`: of each foot, 1/s, (F,). `clearance`: mean over whole swings of the largest height
        of the foot, m. `duty`: share of the time that a foot stands. `power`: mean, W.
    """
    walks = [walk for walk in walks if len(walk.height)]
    if not walks:
        return dict.fromkeys(_VALUES)
    heights = np.array([walk.height.mean() - height for walk in walks])
    pitches = np.array([walk.pitch.mean() - pitch for walk in walks])
    powers = [walk.power.mean() for walk in walks]
    values = (
        *(heights.mean(), np.abs(heights).mean(), pitches.mean(), np.abs(pitches).mean()),
        np.mean([walk.velocity.mean() for walk in walks]),
        np.mean([_lifts(walk) for walk in walks], axis=0).tolist(),
        _mean([peak for walk in walks for peak in _peaks(walk)]),
        np.mean([walk.contact.mean() for walk in walks]),
        np.mean(powers),
    )
    plain = [float(x) if isinstance(x, np.floating) else x for x in values]
    return dict(zip(_VALUES, plain, strict=True))


_VALUES = (
    *("height", "height_error", "pitch", "pitch_error", "velocity"),
    *("lifts", "clearance", "duty", "power"),
)


def _lifts(walk: Walk) -> list[float]:
    """Return how often each foot lifts, (F,), 1/s."""
    return [len(swings(foot, walk.dt)) / walk.duration for foot in walk.contact.T]


def _peaks(walk: Walk) -> list[float]:
    """Return the largest height of the foot in each whole swing, m."""
    return [
        heights[swing.start : swing.stop].max()
        for foot, heights in zip(walk.contact.T, walk.foot_height.T, strict=True)
        for swing in swings(foot, walk.dt)
        if swing.has_landed
    ]


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None
