"""Dynamic time warping against sums that can be done by hand."""

from __future__ import annotations

import sys

import pytest
import torch

from kiras_rl.config import ConfigError
from kiras_rl.evaluation.dtw import dtw, dtw_to_clips, frame_distances


def column(*values):
    """Return a motion of one feature."""
    return torch.tensor(values, dtype=torch.float32)[:, None]


@pytest.mark.parametrize(
    ("first", "second", "distance"),
    [
        (column(0, 0, 3), column(0, 3, 3, 3), 0),  # the same, at another pace
        (column(0, 0, 3), column(0, 3, 3, 1), 2),  # 3 and 1 at the end must be matched
        (column(0, 1, 2), column(2, 1, 0), 4),  # 2 at either end, or 2 + 1 + 1 on the way
        (torch.tensor([[3.0, 4.0], [3.0, 4.0]]), torch.zeros(1, 2), 10),  # 5 a frame, not squared
    ],
)
def test_the_distance_is_the_sum_along_the_cheapest_path(first, second, distance):
    assert dtw(first, second) == pytest.approx(distance)
    assert dtw(second, first) == pytest.approx(distance)


def test_the_distance_to_a_keyframe_is_the_sum_of_the_frames_distances():
    motions, keyframe = torch.randn(5, 40, 12), torch.randn(12)
    expected = [dtw(motion, keyframe.expand(40, 12)) for motion in motions]
    closed_form = frame_distances(motions, keyframe).sum(dim=1)
    torch.testing.assert_close(closed_form, torch.tensor(expected))


def test_a_motion_is_compared_with_every_clip():
    motions = torch.stack([column(0, 0), column(1, 1)])
    nearest, mean = dtw_to_clips(motions, [column(0, 0, 0), column(3)])  # 0 and 6, 3 and 4
    assert nearest.tolist() == [0, 3]
    assert mean.tolist() == [3, 3.5]


def test_a_missing_library_is_one_clear_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "dtaidistance", None)
    with pytest.raises(ConfigError, match=r"pip install 'kiras-rl\[evaluation\]'"):
        dtw(column(0), column(1))
