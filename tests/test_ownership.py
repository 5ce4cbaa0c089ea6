"""A run folder has one writer, for as long as its process lives."""

from __future__ import annotations

import os
import signal

import pytest

from kiras_rl.ownership import FolderInUseError, owning


def test_a_process_may_own_a_folder_twice(tmp_path):
    with owning(tmp_path / "run"), owning(tmp_path / "run"):
        assert (tmp_path / "run").is_dir()


def test_another_process_is_kept_out_until_the_first_one_dies(tmp_path):
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            with owning(tmp_path):
                os.write(write, b"owned")
                signal.pause()
        finally:
            os._exit(1)
    try:
        assert os.read(read, 5) == b"owned"
        message = "is in use: another process trains this run"
        with pytest.raises(FolderInUseError, match=message), owning(tmp_path):
            pass
    finally:
        os.kill(child, signal.SIGKILL)  # it tidies nothing up
        os.waitpid(child, 0)
        os.close(read)
        os.close(write)
    with owning(tmp_path):
        pass
