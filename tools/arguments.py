"""Files that a command is asked to write, checked before it works for them."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

PICTURES = (".png", ".jpg", ".pdf", ".svg")


def file_of(endings: tuple[str, ...]) -> Callable[[str], Path]:
    """Return a type of an option: the path of a file with one of the endings."""

    def check(text: str) -> Path:
        if Path(text).suffix not in endings:
            raise argparse.ArgumentTypeError(f"'{text}' does not end in {' '.join(endings)}")
        return Path(text)

    return check
