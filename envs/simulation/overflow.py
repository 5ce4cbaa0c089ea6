"""Naming the budget that was too small, once a run and without waiting for the device."""

from __future__ import annotations

import logging

import torch

_log = logging.getLogger(__name__)
_INTERVAL = 64  # steps between two looks on CUDA


class OverflowMonitor:
    """Looks at the overflow bits of all worlds and warns of each budget once.

    Attributes:
        seen: All bits that a world has shown, (N,) int32; the simulation adds to them.
    """

    def __init__(self, budgets: dict[int, str], num_worlds: int, device: torch.device) -> None:
        """Allocate.

        Args:
            budgets: Mask of bits -> what overflowed, and what to change.
            num_worlds: N.
            device: Where the bits are.
        """
        self._budgets = list(budgets.values())
        self._masks = torch.tensor(list(budgets), dtype=torch.int32, device=device)
        self.seen = torch.zeros(num_worlds, dtype=torch.int32, device=device)
        # A copy into pinned memory does not wait; what it brought is read an interval later.
        self._on_gpu = device.type == "cuda"
        self._worlds = torch.zeros(len(budgets), dtype=torch.int64, pin_memory=self._on_gpu)
        self._warned: set[str] = set()
        self._steps = 0

    def look(self) -> None:
        """Count the bits once a step."""
        self._steps += 1
        if not self._on_gpu:
            self._count()
            self._warn()
        elif self._steps % _INTERVAL == 0:
            self._warn()
            self._count()

    def _count(self) -> None:
        worlds = (self.seen[:, None] & self._masks).ne(0).sum(dim=0)
        self._worlds.copy_(worlds, non_blocking=True)

    def _warn(self) -> None:
        for budget, worlds in zip(self._budgets, self._worlds.tolist(), strict=True):
            if worlds and budget not in self._warned:
                self._warned.add(budget)
                _log.warning("%s in %d worlds: contacts were lost", budget, worlds)
