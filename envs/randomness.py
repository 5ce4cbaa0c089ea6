"""All random numbers of a control step from one generator, drawn at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch

from kiras_rl.config import ConfigError

JOINTS = -1
"""Numbers of a term that takes one for each joint."""


def columns_of(group: str, terms: Mapping[str, partial[Any]], num_joints: int) -> dict[str, int]:
    """Return the random numbers that terms of a group take each step, in their order.

    Args:
        group: Begin of the columns' names.
        terms: By name; `numbers` of the function says how many, none where it says nothing.
        num_joints: J.
    """
    wanted = {name: getattr(term.func, "numbers", 0) for name, term in terms.items()}
    return {
        f"{group}/{name}": num_joints if count == JOINTS else count
        for name, count in wanted.items()
    }


@dataclass
class Drawing:
    """The random numbers of a term.

    Attributes:
        uniform: Its own, in [0, 1), (N, k).
        where: Its key in the YAML, for messages.
    """

    uniform: torch.Tensor
    where: str

    def between(self, limits: tuple[float, float]) -> torch.Tensor:
        """Return the numbers spread over [low, high), (N, k).

        Raises:
            ConfigError: No pair of numbers in ascending order.
        """
        pair = isinstance(limits, list | tuple) and len(limits) == 2
        if not pair or not all(isinstance(x, int | float) for x in limits) or limits[0] > limits[1]:
            raise ConfigError(f"{self.where}: {limits}: give [low, high], the lower number first")
        return scale_to(self.uniform, *limits)


class UniformBuffer:
    """Uniform numbers in [0, 1), one row a world, refilled once a step.

    Terms take named columns, so that the sequence does not depend on which worlds reset and is
    the same on every backend.
    """

    def __init__(
        self, num_worlds: int, columns: dict[str, int], generator: torch.Generator
    ) -> None:
        """Reserve columns.

        Args:
            num_worlds: N.
            columns: Name -> number of columns.
            generator: The only source of randomness; its device is the buffer's.
        """
        self.generator = generator
        self._slices, start = {}, 0
        for name, width in columns.items():
            self._slices[name] = slice(start, start + width)
            start += width
        self._values = torch.zeros(num_worlds, start, device=generator.device)
        self.refill()

    def refill(self) -> None:
        """Draw new numbers."""
        torch.rand(
            self._values.shape,
            generator=self.generator,
            device=self._values.device,
            out=self._values,
        )

    def __getitem__(self, name: str) -> torch.Tensor:
        """Return the columns of `name`, (N, width)."""
        return self._values[:, self._slices[name]]


def scale_to(uniform: torch.Tensor, low: float, high: float | torch.Tensor) -> torch.Tensor:
    """Map numbers in [0, 1) to [low, high)."""
    return low + (high - low) * uniform
