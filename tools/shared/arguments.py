"""Types of the commands' options: what cannot be is refused before anything is done."""

from __future__ import annotations

import math
from argparse import ArgumentTypeError
from collections.abc import Callable
from pathlib import Path

PICTURES = (".png", ".jpg", ".pdf", ".svg")


def at_least(least: int) -> Callable[[str], int]:
    """Return a type of an option: a whole number."""

    def check(text: str) -> int:
        if not text.isdecimal() or int(text) < least:
            raise ArgumentTypeError(f"'{text}': give a whole number, at least {least}")
        return int(text)

    return check


def seconds_above(limit: float) -> Callable[[str], float]:
    """Return a type of an option: a finite time, s."""

    def check(text: str) -> float:
        try:
            seconds = float(text)
        except ValueError:
            seconds = math.nan
        if not limit < seconds < math.inf:
            raise ArgumentTypeError(f"'{text}': give seconds, more than {limit:g}")
        return seconds

    return check


def file_of(endings: tuple[str, ...]) -> Callable[[str], Path]:
    """Return a type of an option: the path of a file with one of the endings."""

    def check(text: str) -> Path:
        if Path(text).suffix not in endings:
            raise ArgumentTypeError(f"'{text}' does not end in {' '.join(endings)}")
        return Path(text)

    return check
