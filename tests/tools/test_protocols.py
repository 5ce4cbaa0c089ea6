"""What protocols make of counts, and of several seeds."""

from __future__ import annotations

import pytest

from kiras_rl.tools.protocols.crossing import percent, pooled, wilson
from kiras_rl.tools.protocols.pooling import pool


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        # R. G. Newcombe, Statistics in Medicine 17 (1998), table I, method 3
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_intervals_are_wilsons(successes, trials, low, high):
    assert wilson(successes, trials) == pytest.approx((low, high), abs=5e-5)


def test_counts_of_all_skills_add_up():
    cells = {
        "walk": {"trials": 10, "success": 9, "strict": 5},
        "crawl": {"trials": 10, "success": 1, "strict": 0},
    }
    assert pooled(cells) == {"trials": 20, "success": 10, "strict": 5}
    assert percent(pooled(cells), "success") == "50 [30, 70]"


def test_seeds_are_averaged_counts_added_and_curves_kept():
    first = {
        "unit": "cm", "cell": {"trials": 10, "strict": 5}, "error": 1.0, "rows": [[1.0, None]],
        "curves": [{"walk": [[1, 0.2]]}],
    }  # fmt: skip
    second = {
        "unit": "cm", "cell": {"trials": 10, "strict": 1}, "error": 2.0, "rows": [[2.0, 4.0]],
        "curves": [{"walk": [[1, 0.4]]}],
    }  # fmt: skip
    assert pool([first, second]) == {
        "unit": "cm",
        "cell": {"trials": 20, "strict": 6},
        "error": 1.5,
        "rows": [[1.5, 4.0]],
        "curves": [{"walk": [[1, 0.2]]}, {"walk": [[1, 0.4]]}],
    }
    assert pool([first]) is first
