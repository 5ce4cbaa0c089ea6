"""What of a robot belongs to a training."""

from __future__ import annotations

import re

import pytest

from kiras_rl.robots.identity import change, identity
from kiras_rl.robots.robot import load_robot

EDITS = {
    "kp": ("robot.yaml", "kp: 5.0", "kp: 30.0", r"kp \(number 0\) was 5.0 and is 30.0"),
    "keyframe": (
        "keyframes.yaml",
        "stilt: {base_height: 0.30",
        "stilt: {base_height: 0.29",
        "stilt",
    ),
    "name": ("keyframes.yaml", "stilt:", "tall:", "keyframe tall is new"),
    "mjcf": (
        "solo8.xml",
        'frictionloss="0.0477"',
        'frictionloss="0.1"',
        "solo8.xml is",
    ),
}


@pytest.mark.parametrize("name", EDITS)
def test_a_change_is_told(edit_text, name):
    file, old, new, message = EDITS[name]
    before = identity(load_robot("solo8"))

    def edit(text):
        assert old in text
        return text.replace(old, new)

    told = change(before, identity(edit_text(file, edit)))
    assert told is not None
    assert re.search(message, told)


def test_comments_and_what_was_not_kept_before_are_no_change(edit_text):
    before = identity(load_robot("solo8"))
    now = identity(
        edit_text("solo8.xml", lambda text: text.replace("<worldbody>", "<!-- --><worldbody>"))
    )
    assert change(before, now) is None
    del before["velocity_limit"]
    assert change(before, now) is None
