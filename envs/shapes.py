"""What terms of the MDP return, checked: a tensor of the right shape."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch

from kiras_rl.config import ConfigError


def evaluate(
    function: Callable, argument: object, where: str, shape: tuple[int | None, ...]
) -> torch.Tensor:
    """Return what a term gives, as float32.

    Args:
        function: The term.
        argument: What it looks at.
        where: Its key in the YAML, for the message.
        shape: What it has to have; None for any number.

    Raises:
        ConfigError: Something else than a tensor of this shape.
    """
    value = function(argument)
    if isinstance(value, torch.Tensor) and _fits(tuple(value.shape), shape):
        return value.float()
    given = f"shape {_text(value.shape)}" if isinstance(value, torch.Tensor) else repr(value)
    raise ConfigError(f"{where}: the term returns {given}, it has to be of shape {_text(shape)}")


def evaluate_mask(function: Callable, argument: object, where: str, worlds: int) -> torch.Tensor:
    """Return which worlds a term chooses, (worlds,) bool.

    Args:
        function: The term.
        argument: What it looks at.
        where: Its key in the YAML, for the message.
        worlds: N.

    Raises:
        ConfigError: Something else than a bool tensor of this shape.
    """
    value = function(argument)
    if isinstance(value, torch.Tensor) and value.dtype == torch.bool and value.shape == (worlds,):
        return value
    given = repr(value)
    if isinstance(value, torch.Tensor):
        given = f"{value.dtype} of shape {_text(value.shape)}"
    raise ConfigError(f"{where}: the term returns {given}, it has to be bool of shape ({worlds})")


def _fits(given: tuple[int, ...], wanted: tuple[int | None, ...]) -> bool:
    return len(given) == len(wanted) and all(
        b is None or a == b for a, b in zip(given, wanted, strict=True)
    )


def _text(shape: Iterable[int | None]) -> str:
    return f"({', '.join('k' if n is None else str(n) for n in shape)})"
