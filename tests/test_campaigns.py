"""A tenth of the campaigns: see tests/campaigns/."""

from __future__ import annotations

from campaigns.mutations import campaign


def test_damaged_files_are_usable_or_refused_in_one_line():
    assert campaign(range(3)) == []
