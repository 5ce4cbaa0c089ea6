"""Schedules of skill learning: pure functions of its progress t / T1 in [0, 1]."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise


def piecewise_linear(points: Sequence[Sequence[float]], progress: float) -> float:
    """Interpolate [progress, value] points; constant outside them.

    Raises:
        ValueError: Points that are empty or not in ascending order.
    """
    xs = [float(x) for x, _ in points]
    if not xs or xs != sorted(xs):
        raise ValueError(f"schedule {points}: give [fraction, value] points in ascending order")
    if progress <= xs[0]:
        return float(points[0][1])
    for (x0, y0), (x1, y1) in pairwise(points):
        if progress <= x1:
            return float(y0 + (y1 - y0) * (progress - x0) / (x1 - x0))
    return float(points[-1][1])


def advantage_weights(progress: float, sigma: float, omega2_floor: float) -> tuple[float, float]:
    """Return the weights of task and imitation advantages during skill learning.

    omega_1 = sigma t / T1 + (1 - sigma) and omega_2 = 1 - omega_1. The paper prints the second
    term of omega_1 multiplied by t, which leaves [0, 1]; continuity with omega_1(T1) = 1 asks for
    this form. omega_2 stays above a floor, because style decays within the last tenth of T1
    without one.

    Args:
        progress: t / T1.
        sigma: Weight of imitation at the start.
        omega2_floor: Least weight of imitation.
    """
    omega1 = min(sigma * min(progress, 1.0) + 1.0 - sigma, 1.0 - omega2_floor)
    return omega1, 1.0 - omega1
