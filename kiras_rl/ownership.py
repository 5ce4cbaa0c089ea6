"""A folder has one writer: a lock that the system takes away when its process dies."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from kiras_rl import distributed

LOCK = ".lock"

_log = logging.getLogger(__name__)


class FolderInUseError(OSError):
    """A folder that another process writes to."""


@contextmanager
def owning(folder: Path) -> Iterator[None]:
    """Keep other processes from owning a folder, which is made if it is missing.

    A process may own it several times over. Of several ranks the first one owns it for all.

    Raises:
        FolderInUseError: Another process owns it; on all ranks.
    """
    with ExitStack() as kept:
        distributed.from_main(lambda: _own(folder, kept))
        yield


def _own(folder: Path, kept: ExitStack) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder.resolve() / LOCK, timeout=0, is_singleton=True)
    try:
        lock.acquire()
    except Timeout:
        raise FolderInUseError(
            f"{folder} is in use: another process trains this run; wait for its end or stop it"
        ) from None
    except NotImplementedError:  # a file system without locks
        _log.warning("%s cannot be locked: start no second training there", folder)
        return
    kept.callback(lock.release)
