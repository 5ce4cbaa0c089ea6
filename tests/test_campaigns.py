"""A tenth of the campaigns: see tests/campaigns/."""

from __future__ import annotations

import os

import pytest
from campaigns import disks, faults, kills, mutations


def test_damaged_files_are_usable_or_refused_in_one_line():
    assert mutations.campaign(range(3)) == []


def test_a_robot_that_is_broken_on_purpose_is_held_or_damped_in_time_and_the_log_names_it():
    rows, broken = faults.campaign(1, ("go1",))
    assert broken == []
    assert len(rows) == len(faults.FAULTS)


@pytest.mark.slow
def test_killed_trainings_end_with_the_bits_of_one_that_was_not():
    assert kills.campaign(5) == []


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0, reason="mounting a disk takes root")
def test_a_full_disk_is_one_line_and_what_was_whole_stays_whole():
    assert disks.campaign(6) == []
