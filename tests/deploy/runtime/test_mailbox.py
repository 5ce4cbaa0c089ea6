from __future__ import annotations

import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from patience import patience

from kiras_rl.deploy.runtime.mailbox import BusyError, Mailbox, Seat

POINT = np.dtype([("seq", "<u8"), ("value", "<f4", 3)])


def point(seq):
    made = np.zeros((), POINT)
    made["seq"], made["value"] = seq, (1.0, 2.0, seq)
    return made


def test_a_message_arrives_as_it_was(tmp_path):
    writer, reader = Mailbox(tmp_path / "box", POINT), Mailbox(tmp_path / "box", POINT)
    assert reader.get() is None
    writer.put(point(7))
    assert reader.get() == point(7)


def test_a_message_that_is_half_written_leaves_the_one_before(tmp_path):
    writer, reader = Mailbox(tmp_path / "box", POINT), Mailbox(tmp_path / "box", POINT)
    writer.put(point(1))
    assert reader.get() == point(1)
    whole = (tmp_path / "box").read_bytes()
    writer.put(point(2))
    half = (tmp_path / "box").read_bytes()[:9] + whole[9:]
    (tmp_path / "box").write_bytes(half)
    assert reader.get() == point(1)


def test_a_cleared_box_is_empty_for_new_readers(tmp_path):
    Mailbox(tmp_path / "box", POINT).put(point(1))
    box = Mailbox(tmp_path / "box", POINT)
    box.clear()
    assert box.get() is None


def test_a_seat_is_for_one_and_free_once_its_process_is_killed(tmp_path):
    code = (
        "import sys, time; from pathlib import Path; "
        "from kiras_rl.deploy.runtime.mailbox import Seat; "
        "Seat(Path(sys.argv[1])).take(); print('taken', flush=True); time.sleep(600)"
    )
    path = tmp_path / "driver.seat"
    child = subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE)
    try:
        assert child.stdout.readline() == b"taken\n"
        assert Seat(path).is_taken()
        with pytest.raises(BusyError, match=f"driver.*process {child.pid}"):
            Seat(path).take()
    finally:
        os.kill(child.pid, signal.SIGKILL)
        child.wait(patience())
        child.stdout.close()
    assert not Seat(path).is_taken()
    seat = Seat(path)
    seat.take()
    seat.leave()
    assert not Seat(path).is_taken()
