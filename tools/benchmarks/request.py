"""What every part of a benchmark is asked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from kiras_rl.schema import Config

Figures = dict[str, Any]
"""What a part measured: numbers, texts, lists and dictionaries of them."""


@dataclass(frozen=True)
class Request:
    """What is measured, and how often.

    Attributes:
        config: The configuration; `num_envs` is the size of every part that has one size.
        rounds: That are measured.
        device: "cpu" or a CUDA device, for the parts that run on either.
        sizes: Numbers of worlds of the part `scale`; empty for doubling until memory is short.
        peer: Interpreter of the environment in which mjlab is installed, of the part `peer`.
        tell: Takes a line on what a long part has measured so far, which an end of it would lose.
    """

    config: Config
    rounds: int
    device: str
    sizes: tuple[int, ...] = ()
    peer: str | None = None
    tell: Callable[[str], None] = lambda line: None


def native(config: Config) -> Config:
    """Return a configuration on C MuJoCo."""
    return replace(config, sim=replace(config.sim, backend="native"))
