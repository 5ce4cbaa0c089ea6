"""A tenth of the campaigns: see tests/campaigns/."""

from __future__ import annotations

import os

import pytest
from campaigns import disks, faults, kills, mutations, soak

from kiras_rl.deploy.runtime.scripts import parse_script


def test_damaged_files_are_usable_or_refused_in_one_line():
    assert mutations.campaign(range(3)) == []


def test_a_robot_that_is_broken_on_purpose_is_held_or_damped_in_time_and_the_log_names_it():
    rows, broken = faults.campaign(1, ("go1",))
    assert broken == []
    assert len(rows) == len(faults.FAULTS)


@pytest.mark.parametrize("count", range(2, 8))
def test_a_tour_makes_every_change_of_skill(count):
    assert len(soak.changes(soak.tour(count))) == count * (count - 1)


def test_a_script_of_a_soak_is_one_of_kiras_robot_and_as_long_as_asked(make_metadata):
    metadata = make_metadata()
    for minutes in (10, 24 * 60):
        text = soak.script_of(metadata, 60 * minutes)
        assert len(text) < 100_000  # of 131072 that an argument may have
        parse_script(text, metadata)
        seconds = [float(word.split(":")[1]) for word in text.split(",") if ":" in word]
        assert sum(seconds) == pytest.approx(60 * minutes, rel=0.1)


def test_a_short_soak_on_a_clock_of_its_own_finds_nothing():
    report = soak.fast("solo8", 5 / 3600)
    assert report.broken == []
    assert "runtime: a tick takes p50" in "\n".join(report.lines)


@pytest.mark.slow
def test_a_soak_at_real_time_reports_both_loops_or_says_what_damped_it():
    report = soak.real("go1", 1.5)
    assert all("damped by" in what or "change of skill" in what for what in report.broken)
    assert [line.split(" | ")[1] for line in report.lines if line.startswith("|")] == [
        "runtime",
        "driver",
    ]


@pytest.mark.slow
def test_killed_trainings_end_with_the_bits_of_one_that_was_not():
    assert kills.campaign(5) == []


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0, reason="mounting a disk takes root")
def test_a_full_disk_is_one_line_and_what_was_whole_stays_whole():
    assert disks.campaign(6) == []
