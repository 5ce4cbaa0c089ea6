"""Trials on terrain: one cell after the other, with intervals of confidence."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from kiras_rl.envs.quadruped import QuadrupedEnv
from kiras_rl.evaluation.flat import SEED
from kiras_rl.evaluation.terrain import Trials, run_trials
from kiras_rl.tools.protocols.subject import Subject

SPEEDS = (0.2, 0.6)
"""Commanded v_x, m/s: spread evenly over the trials of a skill."""

Z = 1.959963984540054
"""Standard normal quantile of a two-sided 95 % interval."""


@dataclass(frozen=True)
class Obstacle:
    """A tile that robots try to cross.

    Attributes:
        terrain: Name of its type.
        level: Of difficulty in the environment.
        variant: Which of its tiles; None for all in turn.
    """

    terrain: str
    level: int
    variant: int | None = None


def cross(
    env: QuadrupedEnv, subject: Subject, obstacles: list[Obstacle], trials: int, part: int = 0
) -> list[dict]:
    """Try every skill on obstacles, with any heading and speeds over the whole range.

    Args:
        env: Of len(obstacles) * S * trials worlds.
        subject: The policy.
        obstacles: The tiles.
        trials: Of each skill and obstacle.
        part: Which of several draws of robots and headings.

    Returns:
        For each obstacle: skill -> counts of trials, successes, strict successes and falls.
    """
    count, cells = len(env.skills), len(obstacles)

    def deal(values: list[int]) -> torch.Tensor:
        tensor = torch.tensor(values, device=env.device)
        return tensor.repeat_interleave(env.num_envs // len(values))

    skill = torch.arange(count, device=env.device).repeat_interleave(trials).repeat(cells)
    parts = (torch.arange(trials, device=env.device) + 0.5) / trials
    fixed = [o.variant for o in obstacles if o.variant is not None]
    outcomes = run_trials(
        env,
        subject.policy,
        Trials(
            terrain=deal([env.terrains.index(o.terrain) for o in obstacles]),
            level=deal([o.level for o in obstacles]),
            skill=skill,
            speed=(SPEEDS[0] + (SPEEDS[1] - SPEEDS[0]) * parts).repeat(count * cells),
            variant=deal(fixed) if fixed else None,
        ),
        SEED + part,
    )
    flags = {"success": outcomes.success, "strict": outcomes.strict, "fell": outcomes.fell}
    counts = {k: flag.view(cells, count, trials).sum(dim=2).tolist() for k, flag in flags.items()}
    return [
        {
            name: {"trials": trials} | {key: values[k][i] for key, values in counts.items()}
            for i, name in enumerate(env.skills)
        }
        for k in range(cells)
    ]


def share(counts: dict, kind: str) -> float:
    """Return the share of successes of a kind."""
    return counts[kind] / counts["trials"]


def pooled(cells: dict[str, dict]) -> dict:
    """Return the counts of all skills together."""
    keys = next(iter(cells.values()))
    return {key: sum(counts[key] for counts in cells.values()) for key in keys}


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a share (E. B. Wilson, JASA 22, 1927)."""
    p, weight = successes / trials, Z**2 / trials
    middle = (p + weight / 2) / (1 + weight)
    half = math.sqrt(weight * (p * (1 - p) + weight / 4)) / (1 + weight)
    return max(0.0, middle - half), min(1.0, middle + half)


def percent(counts: dict, kind: str) -> str:
    """Return a share and its interval in %, as in `83 [80, 86]`."""
    low, high = wilson(counts[kind], counts["trials"])
    return f"{100 * share(counts, kind):.0f} [{100 * low:.0f}, {100 * high:.0f}]"
