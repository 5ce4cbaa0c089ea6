"""What a training shares with its process: signals, threads and global random numbers."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress

import torch

from kiras_rl import distributed

ENDS = (signal.SIGHUP, signal.SIGINT, signal.SIGTERM)
"""Signals that ask a training to save and end; a closed output raises the first one."""


class StopRequest:
    """Turns the signals of ENDS into a flag while the context is open."""

    def __enter__(self) -> StopRequest:
        """Install the handlers; outside the main thread there are none to install."""
        self.requested = False
        self._old = {}
        with suppress(ValueError):
            for number in ENDS:
                if number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN:
                    continue  # nohup wants to go on
                self._old[number] = signal.signal(number, self._request)
        return self

    def _request(self, number: int, frame: object) -> None:
        self.requested = True
        if number == signal.SIGHUP:  # comes again for every line that nobody can read any more
            return
        if distributed.size() == 1:  # torchrun passes Ctrl-C on, which the terminal gave all before
            signal.signal(number, self._old[number])  # a second one acts at once

    def agree(self) -> bool:
        """Return whether any rank was asked; from then on, all were."""
        self.requested = distributed.any_rank(self.requested)
        return self.requested

    def __exit__(self, *_: object) -> None:
        """Restore the handlers."""
        for number, handler in self._old.items():
            signal.signal(number, handler)


@contextmanager
def threads_of_torch(count: int) -> Iterator[None]:
    """Let torch's operations take so many threads, and as many as before afterwards."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def single_threaded(device: torch.device | str) -> AbstractContextManager[None]:
    """Keep torch to one thread on a CPU: OpenMP's waiting threads would starve the physics."""
    return threads_of_torch(1) if torch.device(device).type == "cpu" else nullcontext()


def generator_states() -> dict[str, torch.Tensor]:
    """Return the states of torch's global generators."""
    states = {"cpu": torch.get_rng_state()}
    if torch.cuda.is_available():
        states["cuda"] = torch.cuda.get_rng_state()
    return states


def set_generator_states(states: dict[str, torch.Tensor]) -> None:
    """Go on with what `generator_states` returned."""
    torch.set_rng_state(states["cpu"])
    if "cuda" in states and torch.cuda.is_available():
        torch.cuda.set_rng_state(states["cuda"])
