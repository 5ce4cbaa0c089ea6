"""The terminal of the commands: text of users, paths among it, is printed as it is."""

from __future__ import annotations

from rich.console import Console


def make_console() -> Console:
    """Return a console that takes no part of a text for markup; styles come in `Text`."""
    return Console(markup=False, emoji=False, highlight=False)
