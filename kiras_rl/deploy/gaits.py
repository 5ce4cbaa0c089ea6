"""The gait that a policy of Walk These Ways keeps on a robot, whose clock is that of the policy."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from kiras_rl.deploy.terms import Reading

FREQUENCY = 3.0  # Hz, of the steps of a foot
SWING_HEIGHT = 0.06  # m
TROT = (0.0, 0.5, 0.5, 0.0)  # turns of left and right front foot, left and right hind foot


def trot_clock(reading: Reading) -> np.ndarray:
    """Return sin(2 pi theta) of the turn theta of each foot, (4,)."""
    return np.sin(2 * np.pi * (FREQUENCY * reading.time + np.array(TROT)))


def trot_behaviour(reading: Reading) -> np.ndarray:
    """Return step frequency and swing height, (2,), Hz and m."""
    return np.array([FREQUENCY, SWING_HEIGHT])
