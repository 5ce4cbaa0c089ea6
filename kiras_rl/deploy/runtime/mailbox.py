"""Memory that two processes share: the newest message of one writer, for any number of readers."""

from __future__ import annotations

import fcntl
import mmap
import os
import zlib
from pathlib import Path

import numpy as np

from kiras_rl.deploy.errors import PlainError

SHARED = Path("/dev/shm")  # memory, whatever the name says
TRIES = 3  # at a message that is being written


class BusyError(PlainError, RuntimeError):
    """Somebody else has the seat; the message says who."""


class Mailbox:
    """Holds the newest message of one writer.

    A reader meets a message that is half written: its checksum tells, and the reader keeps the one
    before. So a writer that is stopped in the middle looks like one that is late.
    """

    def __init__(self, path: Path, dtype: np.dtype) -> None:
        """Open the file, or make it; what another writer left in it is forgotten by `clear`.

        Args:
            path: The file, in memory.
            dtype: Of a message.
        """
        self._dtype = dtype
        self._size = dtype.itemsize + 4
        with open(os.open(path, os.O_RDWR | os.O_CREAT, 0o600), "r+b") as file:
            file.truncate(self._size)
            self._memory = mmap.mmap(file.fileno(), self._size)
        self._last = None

    def clear(self) -> None:
        """Forget the message."""
        self._memory[:] = bytes(self._size)

    def put(self, message: np.ndarray) -> None:
        """Write a message, shape ()."""
        data = message.tobytes()
        self._memory[:] = data + zlib.crc32(data, 1).to_bytes(4, "little")

    def get(self) -> np.ndarray | None:
        """Return the newest whole message, shape (), or None if there was none yet."""
        for _ in range(TRIES):
            data = self._memory[:]
            # Started at 1: memory that is all zero is no message.
            if zlib.crc32(data[:-4], 1).to_bytes(4, "little") == data[-4:]:
                self._last = np.frombuffer(data[:-4], self._dtype)[0].copy()
                break
        return self._last

    def close(self) -> None:
        """Let go of the memory."""
        self._memory.close()


class Seat:
    """A role that one process at a time has; the kernel frees it however the process ends."""

    def __init__(self, path: Path) -> None:
        """Name the seat by a file; nothing is taken yet."""
        self.path = path
        self._file: int | None = None

    def take(self) -> None:
        """Take the seat.

        Raises:
            BusyError: If another process has it.
        """
        file = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o600)
        if not _lock(file):
            owner = os.pread(file, 20, 0).decode("ascii", "replace").strip() or "unknown"
            os.close(file)
            raise BusyError(
                f"another kiras-robot has the {self.path.stem} (process {owner}, {self.path}): "
                "end it first"
            )
        os.truncate(file, 0)
        os.pwrite(file, str(os.getpid()).encode(), 0)
        self._file = file

    def is_taken(self) -> bool:
        """Tell whether a living process has the seat; false from the moment it ends."""
        file = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            return not _lock(file)
        finally:
            os.close(file)  # frees what the test itself has locked

    def leave(self) -> None:
        """Free the seat."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


def _lock(file: int) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
