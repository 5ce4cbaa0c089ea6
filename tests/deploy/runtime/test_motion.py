from __future__ import annotations

import numpy as np
import pytest

from kiras_rl.deploy.runtime.motion import SHORTEST, SPEED, Path

A, B, C = np.zeros(2), np.array([1.6, -0.4]), np.array([1.6, 0.0])


def test_a_path_goes_through_its_poses_and_stays_at_the_last():
    path = Path([A, B, C])
    assert path.duration == pytest.approx(1.875 * 1.6 / SPEED + SHORTEST)
    assert path.at(0.0) == pytest.approx(A)
    assert path.at(3.0) == pytest.approx(B)
    assert path.at(path.duration) == pytest.approx(C)
    assert path.at(99.0) == pytest.approx(C)


def test_no_joint_is_faster_than_allowed_and_the_ends_are_at_rest():
    path = Path([A, B])
    times = np.linspace(0.0, path.duration, 3001)
    speed = np.abs(np.diff([path.at(time) for time in times], axis=0)) / np.diff(times)[:, None]
    assert speed.max() == pytest.approx(SPEED, rel=1e-3)
    assert speed[[0, -1]].max() < 1e-5
    assert path.at(path.duration / 2) == pytest.approx(B / 2)


def test_a_pose_that_is_reached_already_takes_the_shortest_time():
    assert Path([A, A]).duration == SHORTEST
