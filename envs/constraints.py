"""What a policy shall keep to: one pure function each, (Step, parameters) -> (N,) violation.

A violation is 0 where the constraint is kept, and grows with what is beyond. The environment only
measures: a part of the learner says what it costs, a reward or the end of an episode in part.
"""

from __future__ import annotations

from typing import Any

import torch

from kiras_rl.envs.lookup import find_terms
from kiras_rl.envs.shapes import evaluate
from kiras_rl.envs.state import Step

_WHERE = "env.constraints"


def joint_torque(step: Step, share: float) -> torch.Tensor:
    """Return the largest torque beyond `share` of a joint's limit, in limits."""
    return (step.robot.peak_torque / step.limits.torque - share).amax(dim=-1).clamp(min=0.0)


def joint_speed(step: Step, most: float) -> torch.Tensor:
    """Return the largest joint velocity beyond `most` rad/s, rad/s."""
    return (step.robot.joint_vel.abs().amax(dim=-1) - most).clamp(min=0.0)


def foot_force(step: Step, most: float) -> torch.Tensor:
    """Return the largest force on a foot beyond `most` body weights, body weights."""
    return (step.robot.foot_force.amax(dim=-1) / step.weight - most).clamp(min=0.0)


class Constraints:
    """The configured constraints.

    Attributes:
        names: In the order of the YAML.
        functions: Theirs, without parameters.
    """

    def __init__(self, terms: dict[str, Any]) -> None:
        """Look the constraints up.

        Raises:
            ConfigError: Unknown constraint or parameter, or a parameter that is no number.
        """
        self._terms = find_terms(globals(), terms, Step, _WHERE)
        self.names = tuple(self._terms)
        self.functions = [term.func for term in self._terms.values()]

    def __call__(self, step: Step) -> torch.Tensor:
        """Return how far each constraint is violated, (N, number of constraints), at least 0.

        Raises:
            ConfigError: A constraint of another shape than one number per world.
        """
        shape = (len(step.fallen),)
        values = [
            evaluate(term, step, f"{_WHERE}.{name}", shape) for name, term in self._terms.items()
        ]
        return torch.stack(values, dim=1).clamp(min=0.0)
