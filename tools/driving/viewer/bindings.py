"""The keys, in one place for page, terminal and what is printed about them."""

from __future__ import annotations

from kiras_rl.tools.driving.viewer.cockpit import FORWARD, LEFT, YAW, Cockpit

HELD = {
    "W": (FORWARD, 1.0),
    "S": (FORWARD, -1.0),
    "A": (YAW, 1.0),
    "D": (YAW, -1.0),
    "Q": (LEFT, 1.0),
    "E": (LEFT, -1.0),
    "Up": (FORWARD, 1.0),
    "Down": (FORWARD, -1.0),
    "Left": (YAW, 1.0),
    "Right": (YAW, -1.0),
}
"""Keys that act as long as they are held: axis and direction."""

PRESSED = {
    "Space": "stop",
    "P": "push",
    "R": "reset",
    "T": "toggle_pause",
    "N": "single_step",
    "M": "next_speed",
    "F": "next_terrain",
    "K": "lower_level",
    "L": "raise_level",
    "V": "next_variant",
}
"""Keys that act once, by methods of the cockpit; the digits 1 to 9 choose a skill."""

HELP = (
    "1..9 skill   W S faster, slower   A D turn   Q E sideways   Space stop",
    "P push   R reset   T pause   N one step   M slow motion",
    "F next terrain   K L level down, up   V next variant",
)
"""All of them, in three lines."""


def press(cockpit: Cockpit, key: str) -> bool:
    """Post what a key does to the cockpit; return whether it does anything.

    Args:
        cockpit: Who gets it.
        key: A key of `PRESSED`, or a digit.
    """
    if key in PRESSED:
        cockpit.post(getattr(cockpit, PRESSED[key]))
    elif key.isdigit() and 1 <= int(key) <= len(cockpit.skills):
        cockpit.post(cockpit.choose_skill, int(key) - 1)
    else:
        return False
    return True
