"""How every command ends: done, refused, interrupted, hung up, without room. One line each.

Nothing heavy is imported here: an interrupt is caught while the rest is.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

from kiras_rl.deploy.errors import PlainError

STOPPED = "stopped before it was done"
REFUSED = 2

_SIGNALS = ("SIGHUP", "SIGINT", "SIGTERM")
_NO_MEMORY = ("allocate memory", "could not allocate", "bad_alloc", "bad allocation")


class Stopped(KeyboardInterrupt):
    """The process was asked to end; `number` is that of the signal."""

    def __init__(self, number: int) -> None:
        """Remember the signal."""
        super().__init__()
        self.number = number


def finish(
    work: Callable[[], int | None],
    stopped: str = STOPPED,
) -> int:
    """Do the work of a command and say in one line why it ended early, if it did.

    SIGINT, SIGHUP, SIGTERM and an output that nobody reads any more end the work alike. What
    installs handlers of its own, a training, hears of all of them in its own way.

    Args:
        work: Returns the exit status; None is 0.
        stopped: What to say after an interrupt.

    Returns:
        The exit status: that of the work, 2 after a PlainError or an OSError, 128 + the signal
        after an interrupt.
    """
    try:
        with _signals(), _lasting_output(), _quiet_threads():
            return work() or 0
    except KeyboardInterrupt as interrupt:
        status = 128 + getattr(interrupt, "number", int(signal.SIGINT))
        return _say("; ".join([stopped, *getattr(interrupt, "__notes__", ())]), status)
    except Exception as error:
        if is_out_of_memory(error):
            return _say(f"error: not enough memory: {one_line(error)}", REFUSED)
        if isinstance(error, OSError | PlainError):
            return _say(f"error: {one_line(error)}", REFUSED)
        raise


def one_line(error: BaseException) -> str:
    """Return the message of an error and its notes as one line; its kind where it has none."""
    text = "; ".join([str(error) or type(error).__name__, *getattr(error, "__notes__", ())])
    return " ".join(text.split())


def is_out_of_memory(error: BaseException) -> bool:
    """Tell whether memory ran out, of the machine or of a GPU; libraries say it in many ways."""
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    return any(text in str(error).lower() for text in _NO_MEMORY)


def _say(line: str, status: int) -> int:
    with suppress(OSError):  # the terminal may be gone
        print(line, file=sys.stderr, flush=True)
    return status


@contextmanager
def _signals() -> Iterator[None]:
    """Let the signals that end a process interrupt it as Ctrl-C does."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise Stopped(number)

    old = {}
    with suppress(ValueError):  # outside of the main thread there are none to install
        for number in (getattr(signal, name) for name in _SIGNALS):
            if signal.getsignal(number) is not signal.SIG_IGN:  # nohup wants to go on
                old[number] = signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)


@contextmanager
def _lasting_output() -> Iterator[None]:
    """Take a closed output for a hang-up, once; what is printed after that is lost."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (stream and _Output(stream) for stream in before)
    try:
        yield
        if sys.stdout:
            sys.stdout.flush()
    finally:
        sys.stdout, sys.stderr = before


@contextmanager
def _quiet_threads() -> Iterator[None]:
    """Leave what the system refuses a thread that writes to the one that waits for it.

    The thread of TensorBoard's log keeps its error for the next line, and prints it besides.
    """
    before = threading.excepthook

    def tell(fault: threading.ExceptHookArgs) -> None:
        if not isinstance(fault.exc_value, OSError):
            before(fault)

    threading.excepthook = tell
    try:
        yield
    finally:
        threading.excepthook = before


class _Output:
    """A text stream whose end is a hang-up and no error of whoever writes."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except OSError:
            self._hang_up()
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except OSError:
            self._hang_up()

    def _hang_up(self) -> None:
        """Lead the file elsewhere, so that nothing fails again, and end as a terminal would."""
        with suppress(OSError, ValueError), open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), self._stream.fileno())
        if callable(signal.getsignal(signal.SIGHUP)):
            signal.raise_signal(signal.SIGHUP)
