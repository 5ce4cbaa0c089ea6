"""All random numbers of a control step from one generator, drawn at once."""

from __future__ import annotations

import torch


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
