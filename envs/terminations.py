"""Ends of an episode by failure: one pure function a reason, (Step, parameters) -> (N,) bool.

Time-outs are no failure, and broken physics is one whatever is configured: neither stands here.
"""

from __future__ import annotations

import math
from typing import Any

import torch

from kiras_rl.envs.lookup import TermSet
from kiras_rl.envs.shapes import evaluate_mask
from kiras_rl.envs.state import Step


def base_contact(step: Step, force: float) -> torch.Tensor:
    """Return the worlds whose base pressed on the ground with more than `force` N."""
    return (step.robot.base_force > force).any(dim=-1)


def tilted(step: Step, angle: float) -> torch.Tensor:
    """Return the worlds whose gravity is more than `angle` degrees from both target and start."""
    gravity, poses = step.robot.gravity_b, step.keyframes.gravity_b
    target = (gravity * poses[step.task.skill]).sum(-1)
    start = (gravity * poses[step.task.start]).sum(-1)
    return torch.maximum(target, start) < math.cos(math.radians(angle))


class Terminations(TermSet):
    """The configured reasons for an episode to end by failure."""

    def __init__(self, terms: dict[str, Any]) -> None:
        """Look the reasons up.

        Raises:
            ConfigError: Unknown reason or parameter, or a parameter that is no number.
        """
        super().__init__(globals(), terms, Step, "env.terminations.terms")

    def __call__(self, step: Step) -> list[torch.Tensor]:
        """Return the worlds that end by each of the reasons, (N,) bool each.

        Raises:
            ConfigError: A term of another shape or type.
        """
        worlds = len(step.fallen)
        return [
            evaluate_mask(term, step, f"{self._where}.{name}", worlds)
            for name, term in self.terms.items()
        ]
