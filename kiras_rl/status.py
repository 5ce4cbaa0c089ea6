"""What is known of a training after an iteration."""

from __future__ import annotations

from dataclasses import dataclass

from kiras_rl.evaluation.flat import SkillResult
from kiras_rl.evaluation.terrain import TerrainResult


@dataclass
class Status:
    """What a progress line shows after an iteration.

    Attributes:
        phase: Name of the phase, see kiras_rl.phases.
        iteration: Iterations done, over all phases.
        iterations: Iterations in all.
        steps: Environment steps done, over all phases and ranks.
        seconds: Wall time of this iteration.
        scalars: Everything that was logged for it.
        evaluation: The latest deterministic evaluation on flat ground, empty before the first.
        terrain: The latest one on terrain, None where there is none.
    """

    phase: str
    iteration: int
    iterations: int
    steps: int
    seconds: float
    scalars: dict[str, float]
    evaluation: dict[str, SkillResult]
    terrain: TerrainResult | None
