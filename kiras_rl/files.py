"""Files that are whole or not there."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from io import RawIOBase
from pathlib import Path

_BLOCK = 1 << 20


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a new file to write, which takes the place of `path` when it is whole.

    A crash at any moment leaves the old file or the new one. Its folder is made if it is missing.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")  # same folder: rename is atomic
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def remove_leftovers(folder: Path) -> None:
    """Remove the files that `replacing` began in a folder, in processes that were killed.

    The folder must have no other writer.
    """
    for temporary in folder.glob(".*.tmp"):
        if temporary.is_file():
            temporary.unlink()


class TornFileError(OSError):
    """A file that does not read as it was written."""


class CheckedFile:
    """A new file that knows the checksum of what was written to it, for libraries that write.

    Bytes are written one after the other: it cannot seek.
    """

    def __init__(self, file: RawIOBase) -> None:
        """Write to an open, empty file without a buffer."""
        self._file, self._sum = file, 0

    def write(self, data: bytes) -> int:
        """Write all of `data`."""
        rest = memoryview(data)
        self._sum = zlib.crc32(rest, self._sum)
        while rest:  # a disk that is nearly full takes a part
            rest = rest[self._file.write(rest) :]
        return len(data)

    def flush(self) -> None:
        """Hand everything to the system."""
        self._file.flush()

    def check(self, path: Path) -> None:
        """Put the file onto the disk and read it back from there.

        Raises:
            TornFileError: It is another one than was written.
        """
        self.flush()
        os.fsync(self._file.fileno())
        os.posix_fadvise(self._file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)  # not from memory
        found = 0
        with path.open("rb") as file:
            while block := file.read(_BLOCK):
                found = zlib.crc32(block, found)
        if found != self._sum:
            raise TornFileError(f"{path} does not read as it was written: look at the disk")
