"""Timing that a busy machine disturbs little: interleaved rounds, medians, ratios."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from functools import reduce, wraps
from statistics import median
from typing import Any

import torch

Times = dict[str, list[float]]
"""Variant -> seconds, one a round."""


def interleave(variants: dict[str, Callable[[], float]], rounds: int) -> Times:
    """Run every variant once a round: A B C A B C, so that noise from outside hits all alike.

    Args:
        variants: Name -> function that runs once and returns the seconds that count.
        rounds: Rounds that are kept; one more goes before them, to warm caches up.
    """
    times: Times = {name: [] for name in variants}
    for index in range(rounds + 1):
        for name, run in variants.items():
            seconds = run()
            if index:
                times[name].append(seconds)
    return times


def ratios(times: Times, above: str, below: str) -> list[float]:
    """Return the seconds of `above` over those of `below`, round by round."""
    return [a / b for a, b in zip(times[above], times[below], strict=True)]


def summarise(values: list[float]) -> dict[str, float]:
    """Return median, smallest and largest."""
    return {"median": median(values), "min": min(values), "max": max(values)}


def wait_for(device: torch.device | str) -> None:
    """Wait until a device has done what it was asked; a CPU always has.

    While a graph is recorded nothing is done, and waiting is forbidden.
    """
    if torch.device(device).type == "cuda" and not torch.cuda.is_current_stream_capturing():
        torch.cuda.synchronize(device)


class PartTimer:
    """Splits the time of nested calls into parts, each without the parts that it calls.

    On a GPU every call is waited for, which costs some of the time that is measured.

    Attributes:
        seconds: Part -> time since the last `clear`, s.
    """

    def __init__(self, device: torch.device | str = "cpu") -> None:
        """Begin with nothing timed."""
        self._device = device
        self.seconds: dict[str, float] = {}
        self._inner: list[float] = []  # time of the calls inside each call that is running
        self._wrapped: list[tuple[object, str]] = []

    def wrap(self, owner: Any, method: str, part: str) -> None:
        """Time every call of `owner.method` as `part`."""
        function = getattr(owner, method)
        self.seconds.setdefault(part, 0.0)

        @wraps(function)
        def timed(*args: Any, **kwargs: Any) -> Any:
            self._inner.append(0.0)
            wait_for(self._device)
            begin = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                wait_for(self._device)
                elapsed = time.perf_counter() - begin
                self.seconds[part] += elapsed - self._inner.pop()
                if self._inner:
                    self._inner[-1] += elapsed

        setattr(owner, method, timed)
        self._wrapped.append((owner, method))

    def wrap_all(self, root: Any, parts: Iterable[tuple[str, str, str]]) -> None:
        """Time (owner, method, part) each; an owner is named from `root`, as `alg.parts.imitation`.

        An owner that does not exist has nothing to time.
        """
        for path, method, part in parts:
            names = path.split(".") if path else []
            owner = reduce(child, names, root)
            if owner is not None:
                self.wrap(owner, method, part)

    def clear(self) -> None:
        """Forget the times."""
        self.seconds = dict.fromkeys(self.seconds, 0.0)

    def unwrap(self) -> None:
        """Give every owner its own methods back."""
        for owner, method in reversed(self._wrapped):
            delattr(owner, method)
        self._wrapped.clear()


def child(owner: Any, name: str) -> Any:
    """Return what a dictionary or an object calls by this name, None where there is none."""
    return owner.get(name) if isinstance(owner, dict) else getattr(owner, name, None)
