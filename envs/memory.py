"""What terms remember from step to step, kept by the environment and written by the terms.

A memory is a function (what was remembered, Step) -> what is remembered next. The term that needs
it says so, and finds it under the function itself:

    def air_time(before, step):
        return (before + step.dt) * ~step.robot.foot_stands

    @remembering(air_time)
    def feet_air_time(step, target):
        ... step.memory[air_time] ...

A term sees what was remembered before its step. After a reset everything is zero.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import torch

from kiras_rl.config import ConfigError

if TYPE_CHECKING:
    from kiras_rl.envs.state import Step

Update = Callable[[torch.Tensor, "Step"], torch.Tensor]
"""(N, F) before the step, and the step -> (N, F) after it; one number per world and foot."""


def remembering(*updates: Update) -> Callable[[Callable], Callable]:
    """Mark a term as one that reads these memories."""

    def mark(term: Callable) -> Callable:
        term.memories = updates
        return term

    return mark


class Memory:
    """The memories that some terms ask for, as one attribute each; see the module."""

    def __init__(
        self, terms: Iterable[Callable], num_worlds: int, feet: int, device: torch.device
    ) -> None:
        """Begin with zeros; a memory that several terms read is kept once.

        Raises:
            ConfigError: Two memories of one name.
        """
        self._updates: dict[str, Update] = {}
        for update in (update for term in terms for update in getattr(term, "memories", ())):
            name = update.__name__
            if self._updates.setdefault(name, update) is not update:
                raise ConfigError(f"two terms remember different things as '{name}': rename one")
        for name in self._updates:
            setattr(self, name, torch.zeros(num_worlds, feet, device=device))

    @property
    def names(self) -> list[str]:
        """Names of the attributes."""
        return list(self._updates)

    def __getitem__(self, update: Update) -> torch.Tensor:
        """Return what a memory holds, (N, F)."""
        return getattr(self, update.__name__)

    def advance(self, step: Step) -> None:
        """Remember a step."""
        after = {name: update(self[update], step) for name, update in self._updates.items()}
        for name, values in after.items():
            setattr(self, name, values)

    def forget(self, worlds: torch.Tensor) -> None:
        """Begin anew in some worlds, (N,) bool."""
        for name in self._updates:
            setattr(self, name, getattr(self, name).masked_fill(worlds[:, None], 0.0))

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return all that is remembered."""
        return {name: getattr(self, name) for name in self._updates}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Go on from a saved state."""
        for name in self._updates:
            setattr(self, name, state[name].to(getattr(self, name).device))
