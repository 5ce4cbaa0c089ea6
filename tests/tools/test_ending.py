"""How commands end: one line, whatever ended them, and what was done is kept."""

from __future__ import annotations

import io
import os
import signal
import sys
import threading

import pytest

from kiras_rl.deploy.errors import PlainError
from kiras_rl.process import ENDS, StopRequest
from kiras_rl.tools.shared.ending import finish


@pytest.fixture(autouse=True)
def awake():
    """Hear Ctrl-C even in the background of a shell, where Python leaves it ignored."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in ENDS}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", ENDS)
def test_a_signal_ends_the_work_in_one_line(number, capsys):
    assert finish(lambda: signal.raise_signal(number), stopped="stopped") == 128 + number
    assert capsys.readouterr() == ("", "stopped\n")


@pytest.mark.parametrize("number", ENDS)
def test_a_training_hears_the_signal_in_its_own_way(number, capsys):
    def work():
        with StopRequest() as stop:
            signal.raise_signal(number)
            return 7 if stop.requested else 0

    assert finish(work) == 7
    assert capsys.readouterr().err == ""


def test_a_hang_up_never_acts_at_once():
    with StopRequest() as stop:
        for _ in range(3):  # the terminal, the shell, and every line that nobody reads
            signal.raise_signal(signal.SIGHUP)
        assert stop.requested


def test_a_hang_up_that_is_ignored_stays_ignored():
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # nohup
    with StopRequest() as stop:
        signal.raise_signal(signal.SIGHUP)
        assert not stop.requested


def closed_pipe():
    """Return a text file that nobody reads any more."""
    read, write = os.pipe()
    os.close(read)
    return io.TextIOWrapper(os.fdopen(write, "wb", buffering=0), write_through=True)


def test_a_closed_output_asks_a_training_to_stop(monkeypatch):
    with closed_pipe() as output:
        monkeypatch.setattr("sys.stdout", output)

        def work():
            with StopRequest() as stop:
                sys.stdout.write("a line that is lost\n")
                sys.stdout.write("and another one\n")
                return 7 if stop.requested else 0

        assert finish(work) == 7


def test_a_closed_output_ends_other_work(monkeypatch, capsys):
    with closed_pipe() as output:
        monkeypatch.setattr("sys.stdout", output)
        assert (
            finish(lambda: sys.stdout.write("lost") and 0, stopped="stopped") == 128 + signal.SIGHUP
        )
    assert capsys.readouterr().err == "stopped\n"


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (MemoryError(), "error: not enough memory: MemoryError"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: 9 bytes"), "error: not enough"),
        (OSError(28, "No space left on device"), "error: [Errno 28] No space left on device"),
        (PlainError("two\nlines"), "error: two lines"),
    ],
)
def test_a_mistake_is_one_line(error, line, capsys):
    def work():
        raise error

    assert finish(work) == 2
    err = capsys.readouterr().err
    assert err.startswith(line) and err.count("\n") == 1


def test_what_the_disk_refuses_a_thread_is_left_to_who_waits_for_it(capsys):
    def refuse():
        raise OSError(28, "No space left on device")

    def work():
        thread = threading.Thread(target=refuse)
        thread.start()
        thread.join()

    assert finish(work) == 0
    assert capsys.readouterr() == ("", "")


def test_a_fault_of_the_program_is_no_mistake_of_its_user():
    def work():
        raise KeyError("x")

    with pytest.raises(KeyError):
        finish(work)
