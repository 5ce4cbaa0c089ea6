"""Files that commands write where a user says: one never takes the place of a file of another kind.

Every such file carries the name of what wrote it, as the metadata of its format.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from matplotlib.figure import Figure

from kiras_rl.files import replacing

_LOOK = 1 << 16  # bytes at the begin and at the end of a file, where formats keep metadata


class OutputError(OSError):
    """A place that is not to be written to: says what is there."""


def check_output(path: Path, writer: str) -> None:
    """Refuse the place of a file that the same command has not written; call it before the work.

    Args:
        path: Where the output shall lie.
        writer: Command and option, as the file carries it.

    Raises:
        OutputError: There is something else, or nothing can be written there.
    """
    if path.is_dir():
        raise OutputError(f"{path} is a folder: name a file")
    if path.exists() and not _carries(path, writer.encode()):
        refuse(path)
    path.parent.mkdir(parents=True, exist_ok=True)


def refuse(path: Path) -> NoReturn:
    """Say that a file is another's.

    Raises:
        OutputError: Always.
    """
    raise OutputError(
        f"{path} is there and was not written by this command: name another file, or remove it"
    )


def save_figure(figure: Figure, path: Path, writer: str, **options: Any) -> None:
    """Write a figure, whole or not at all; the ending of the path decides the format.

    Args:
        figure: What to write.
        path: Where to.
        writer: As of `check_output`.
        options: Of savefig.

    Raises:
        OutputError: As `check_output`.
    """
    check_output(path, writer)
    kind = path.suffix[1:]
    if kind in ("jpg", "jpeg"):
        options["pil_kwargs"] = {"comment": writer.encode()}
    else:
        options["metadata"] = {"Software" if kind == "png" else "Creator": writer}
    with replacing(path) as temporary:
        figure.savefig(temporary, format=kind, **options)


def save_arrays(arrays: dict[str, np.ndarray], path: Path, writer: str) -> None:
    """Write arrays as an .npz file, whole or not at all.

    Raises:
        OutputError: As `check_output`.
    """
    check_output(path, writer)
    named: dict[str, Any] = {**arrays}  # numpy's types take each for an option, too
    with replacing(path) as temporary:
        with temporary.open("wb") as file:
            np.savez_compressed(file, **named)
        with zipfile.ZipFile(temporary, "a") as archive:
            archive.comment = writer.encode()


def _carries(path: Path, mark: bytes) -> bool:
    with path.open("rb") as file:
        if mark in file.read(_LOOK):
            return True
        file.seek(max(0, path.stat().st_size - _LOOK))
        return mark in file.read()
