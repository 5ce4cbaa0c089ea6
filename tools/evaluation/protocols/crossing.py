"""Trials on terrain as counts, and their shares with intervals of confidence."""

from __future__ import annotations

import math

from kiras_rl.envs.quadruped import QuadrupedEnv
from kiras_rl.evaluation.flat import SEED
from kiras_rl.evaluation.terrain import Obstacle, cross
from kiras_rl.tools.evaluation.protocols.subject import Subject

SPEEDS = (0.2, 0.6)
"""Commanded v_x, m/s: spread evenly over the trials of a cell."""

KINDS = ("success", "feet_only", "strict")
"""Of what a cell of a table gives the shares."""

KINDS_NOTE = "Success / on feet only / strict, in %."

Z = 1.959963984540054
"""Standard normal quantile of a two-sided 95 % interval."""


def count(
    env: QuadrupedEnv, subject: Subject, obstacles: list[Obstacle], trials: int, part: int = 0
) -> list[dict]:
    """Try every skill on obstacles; see `kiras_rl.evaluation.terrain.cross`.

    Args:
        env: Of len(obstacles) * S * trials worlds.
        subject: The policy.
        obstacles: The tiles.
        trials: Of each skill and obstacle.
        part: Which of several draws of robots and headings.

    Returns:
        For each obstacle: skill -> counts of trials, and of each of the Outcomes.
    """
    outcomes = cross(env, subject.policy_in(env), obstacles, trials, SPEEDS, SEED + part)
    counts = {kind: flags.sum(dim=-1).tolist() for kind, flags in vars(outcomes).items()}
    return [
        {
            skill: {"trials": trials} | {kind: values[k][i] for kind, values in counts.items()}
            for i, skill in enumerate(env.skills)
        }
        for k in range(len(obstacles))
    ]


def share(counts: dict, kind: str) -> float:
    """Return the share of successes of a kind."""
    return counts[kind] / counts["trials"]


def shares(counts: dict) -> str:
    """Return the shares of KINDS in %, as in `95 / 90 / 41`."""
    return " / ".join(f"{100 * share(counts, kind):.0f}" for kind in KINDS)


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
