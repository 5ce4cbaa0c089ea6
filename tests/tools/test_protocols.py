"""What protocols make of counts, and of several seeds."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from kiras_rl.config import ConfigError
from kiras_rl.tools.evaluate import chosen
from kiras_rl.tools.evaluation.protocols import learning, sampling, transitions
from kiras_rl.tools.evaluation.protocols.crossing import percent, pooled, wilson
from kiras_rl.tools.evaluation.protocols.pooling import pool


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


def test_skill_sampling_shows_mean_and_range_of_the_seeds():
    seeds = [
        {"walk": [[1, 0.2], [2, 0.4], [4, 0.4]], "crawl": [[1, 0.8], [2, 0.6], [4, 0.6]]},
        {"walk": [[1, 0.4], [2, 0.6], [3, 0.6]], "crawl": [[1, 0.6], [2, 0.4], [3, 0.4]]},
    ]
    section = sampling.section({"ours": {"first_phase": 2, "curves": seeds}})
    (table,) = section.tables
    # at 1/2, before the first iteration, at 3/2, 2 and the last iteration that both seeds have
    assert table.rows[0] == ("ours", "walk", None, *(pytest.approx(x) for x in (40, 50, 50)))
    (axis,) = section.figures[0].drawing.axes
    x, mean = axis.lines[0].get_data()
    assert (x[0], x[-1]) == (1, 3)
    assert (mean[0], mean[-1]) == (pytest.approx(0.3), pytest.approx(0.5))
    band = axis.collections[0].get_paths()[0].vertices
    assert (band[:, 1].min(), band[:, 1].max()) == (pytest.approx(0.2), pytest.approx(0.6))
    phases = [(p.get_x(), p.get_x() + p.get_width()) for p in axis.patches]
    assert phases == [(0, 2), (2, 3)]
    young = sampling.section({"ours": {"first_phase": 8, "curves": seeds}}).tables[0]
    assert young.rows[0][2:] == (pytest.approx(50), None, None, pytest.approx(50))


def test_learning_tells_when_every_seed_had_all_skills():
    def seed(at_floor, ends=(2.0, 0.1)):
        steps = [1.0, 2.0, 3.0]
        errors = {"height_error": [9.0, 9.0, ends[0]], "velocity_error": [0.9, 0.9, ends[1]]}
        minutes = [2.0 * x for x in steps]
        return {"steps": steps, "minutes": minutes, "at_floor": at_floor} | errors

    section = learning.section(
        {
            "ours": {"skills": 5, "curves": [seed([1, 5, 5]), seed([0, 2, 5], (4.0, 0.3))]},
            "theirs": {"skills": 5, "curves": [seed([0, 5, 4]), seed([0, 2, 4])]},
        }
    )
    ours, theirs = section.tables[0].rows
    assert ours == ("ours", 2, 2.5, 5.0, 5.0, 3.0, pytest.approx(0.2))
    assert theirs == ("theirs", 2, None, None, 4.0, 2.0, pytest.approx(0.1))
    for figure, last in zip(section.figures, (3.0, 6.0), strict=True):
        x, y = figure.drawing.axes[0].lines[0].get_data()
        assert (x[-1], y[0], y[-1]) == (last, 0.5, 5.0)


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


def test_what_one_seed_lacks_is_the_others():
    curve = {"mean": [1.0], "low": [0.0]}
    assert pool([{"height": curve}, {}]) == {"height": curve}
    assert pool([{"height": curve}, {"height": None}]) == {"height": curve}


def one_skill():
    """Return a subject that walks and can do nothing else, and has no run."""
    return SimpleNamespace(
        skills=("walk",), label="mine", is_finetuned=False, source=Path("mine.onnx")
    )


def test_a_robot_of_one_skill_is_measured_by_all_that_needs_no_second_one():
    names = chosen(None, [one_skill()])
    assert "transitions" not in names
    assert {"flat", "imitation", "limits"} <= set(names)


def test_transitions_of_one_skill_are_refused_where_they_are_named():
    assert chosen(["transitions"], [one_skill()]) == ["transitions"]
    with pytest.raises(ConfigError, match="mine has walk alone: name other protocols with"):
        transitions.measure(one_skill())
