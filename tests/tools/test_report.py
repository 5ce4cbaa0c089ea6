"""Reports: tables, the page made of them, and results that survive an interruption."""

from __future__ import annotations

import csv
import io
import re

import pytest
from matplotlib.figure import Figure as Drawing
from rich.console import Console

from kiras_rl.config import ConfigError
from kiras_rl.tools.evaluation.report.content import Column, Figure, Section, Table
from kiras_rl.tools.evaluation.report.files import as_csv, write_report
from kiras_rl.tools.evaluation.report.ledger import Ledger
from kiras_rl.tools.evaluation.report.terminal import as_rich

TABLE = Table(
    "Errors <of> skills",
    (Column("skill"), Column("policy"), Column("height", "cm", "{:.1f}", best="low")),
    [
        ("walk", "a", 0.44),
        ("walk", "b", 0.21),
        ("crawl", "a", 0.1),
        ("crawl", "b", None),
    ],
)


def test_the_best_number_is_marked_among_the_policies_of_one_skill():
    assert TABLE.best_rows(2) == {1}  # crawl has no other number to be better than


def test_a_row_has_a_cell_a_column():
    with pytest.raises(ValueError, match="2 cells for 1 columns"):
        Table("t", (Column("a"),), [(1, 2)])


def test_a_column_can_be_left_out():
    table = TABLE.without("policy")
    assert [c.name for c in table.columns] == ["skill", "height"]
    assert table.rows[0] == ("walk", 0.44)


def test_files_hold_all_digits():
    rows = list(csv.reader(io.StringIO(as_csv(TABLE))))
    assert rows[0] == ["skill", "policy", "height [cm]"]
    assert rows[1] == ["walk", "a", "0.44"]
    assert rows[4] == ["crawl", "b", ""]


def test_a_terminal_shows_rounded_numbers_and_units_in_brackets_stay_text():
    console = Console(width=100, record=True, file=io.StringIO())
    console.print(
        as_rich(Table("t", (Column("delay [ms]", "cm"), Column("x")), [("[red]", 0.126)]))
    )
    text = console.export_text()
    assert "delay [ms]" in text and "[red]" in text and "0.13" in text


def test_a_narrow_terminal_cuts_no_word():
    columns = (Column("skill"), *(Column("clearance", "cm") for _ in range(6)))
    rows = [(skill, *[0.5] * 6) for skill in ("pitch_up", "pitch_down")]
    console = Console(width=60, record=True, file=io.StringIO())
    console.print(as_rich(Table("t", columns, rows)))
    text = console.export_text()
    assert "pitch_up" in text and "pitch_down" in text and "…" not in text


def test_the_page_needs_nothing_else(tmp_path):
    drawing = Drawing()
    drawing.subplots().plot([0, 1])
    section = Section("errors", "Errors & more", "Text.", [TABLE], [Figure("Curve", drawing)])
    page = write_report(tmp_path / "new", "KiRAS: Title", TABLE, [section])
    text = page.read_text()
    assert "Errors &amp; more" in text and "Errors &lt;of&gt; skills" in text
    assert text.count("<svg") == 1
    assert not re.search(r"(src|href)=\"(?!#)", text)  # no file, no address
    assert (tmp_path / "new/tables/errors_errors_of_skills.csv").is_file()
    again = write_report(tmp_path / "new", "KiRAS: Title", TABLE, [section])
    assert again.read_text() == text


def test_a_result_is_measured_once(tmp_path):
    subject = {"sha256": "1", "label": "one"}
    Ledger(tmp_path, subject).get("key", lambda: {"x": [1, (2, 3)]})

    def fail():
        raise AssertionError("measured twice")

    assert Ledger(tmp_path, subject).get("key", fail) == {"x": [1, [2, 3]]}


def test_an_interruption_keeps_what_there_is(tmp_path):
    subject = {"sha256": "1", "label": "one"}
    ledger = Ledger(tmp_path, subject)
    ledger.get("first", lambda: 1)

    def interrupt():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ledger.get("second", interrupt)
    assert Ledger(tmp_path, subject).content["results"] == {"first": 1}


def test_two_evaluations_at_once_keep_each_other_s_results(tmp_path):
    subject = {"sha256": "1", "label": "one"}
    first, second = Ledger(tmp_path, subject), Ledger(tmp_path, subject)
    first.get("mine", lambda: 1)
    second.get("yours", lambda: 2)
    first.get("later", lambda: 3)
    results = {"mine": 1, "yours": 2, "later": 3}
    assert Ledger(tmp_path, subject).content["results"] == results


def test_another_policy_gets_a_folder_beside(tmp_path):
    one = Ledger.beside(tmp_path / "policy", {"sha256": "1" * 64, "label": "one"})
    other = Ledger.beside(tmp_path / "policy", {"sha256": "2" * 64, "label": "other"})
    assert one.path.parent == tmp_path / "policy"
    assert other.path.parent == tmp_path / "policy_22222222"
    again = Ledger.beside(tmp_path / "policy", {"sha256": "1" * 64, "label": "one"})
    assert again.path == one.path


def test_results_of_another_policy_are_not_mixed_in(tmp_path):
    Ledger(tmp_path, {"sha256": "1", "label": "one"}).get("key", lambda: 1)
    with pytest.raises(ConfigError, match=r"results of another policy \(one\).*--out"):
        Ledger(tmp_path, {"sha256": "2", "label": "two"})


def test_a_file_that_holds_no_results_is_left_alone(tmp_path):
    (tmp_path / "results.json").write_text("{")
    with pytest.raises(ConfigError, match="holds no results of kiras-evaluate"):
        Ledger(tmp_path, {"sha256": "1", "label": "one"})
    assert (tmp_path / "results.json").read_text() == "{"
