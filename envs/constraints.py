"""What a policy shall keep to: one pure function each, (Step, parameters) -> (N,) violation.

A violation is 0 where the constraint is kept, and grows with what is beyond. The environment only
measures: a part of the learner says what it costs, a reward or the end of an episode in part.
"""

from __future__ import annotations

from typing import Any

import torch

from kiras_rl.envs.lookup import TermSet
from kiras_rl.envs.memory import remembering
from kiras_rl.envs.rewards import air_time
from kiras_rl.envs.shapes import evaluate
from kiras_rl.envs.state import Step


def joint_torque(step: Step, share: float) -> torch.Tensor:
    """Return the largest torque beyond `share` of a joint's limit, in limits."""
    return (step.robot.peak_torque / step.limits.torque - share).amax(dim=-1).clamp(min=0.0)


def joint_speed(step: Step, most: float) -> torch.Tensor:
    """Return the largest joint velocity beyond `most` rad/s, rad/s."""
    return (step.robot.joint_vel.abs().amax(dim=-1) - most).clamp(min=0.0)


def foot_force(step: Step, most: float) -> torch.Tensor:
    """Return the largest force on a foot beyond `most` body weights, body weights."""
    return (step.robot.foot_force.amax(dim=-1) / step.weight - most).clamp(min=0.0)


def joint_acceleration(step: Step, most: float) -> torch.Tensor:
    """Return the largest mean joint acceleration beyond `most` rad/s^2, rad/s^2."""
    rate = (step.robot.joint_vel - step.last_joint_vel).abs() / step.dt
    return (rate.amax(dim=-1) - most).clamp(min=0.0)


def action_rate(step: Step, most: float) -> torch.Tensor:
    """Return the fastest change of an action beyond `most` 1/s, 1/s."""
    rate = (step.action - step.last_action).abs() / step.dt
    return (rate.amax(dim=-1) - most).clamp(min=0.0)


def limb_contact(step: Step, force: float) -> torch.Tensor:
    """Return 1 where a thigh or shank presses with more than `force` N."""
    return (step.robot.limb_force > force).any(dim=-1).float()


@remembering(air_time)
def short_swing(step: Step, least: float) -> torch.Tensor:
    """Return by how much the shortest swing that ends now is below `least` s, s; 0 if standing."""
    flown = step.memory[air_time]
    lands = step.robot.foot_stands & (flown > 0.0)
    lacking = torch.where(lands, (least - flown).clamp(min=0.0), 0.0)
    return lacking.amax(dim=-1) * step.moves


def idle_speed(step: Step, most: float) -> torch.Tensor:
    """Return the largest joint velocity beyond `most` rad/s of a robot told to stand, rad/s."""
    return joint_speed(step, most) * step.stands


def standing_feet(step: Step, feet: float) -> torch.Tensor:
    """Return by how many the feet on the ground differ from `feet` while it is told to move."""
    return (step.robot.foot_stands.float().sum(dim=-1) - feet).abs() * step.moves


class Constraints(TermSet):
    """The configured constraints."""

    def __init__(self, terms: dict[str, Any]) -> None:
        """Look the constraints up.

        Raises:
            ConfigError: Unknown constraint or parameter, or a parameter that is no number.
        """
        super().__init__(globals(), terms, Step, "env.constraints")

    def __call__(self, step: Step) -> torch.Tensor:
        """Return how far each constraint is violated, (N, number of constraints), at least 0.

        Raises:
            ConfigError: A constraint of another shape than one number per world.
        """
        shape = (len(step.fallen),)
        values = [
            evaluate(term, step, f"{self._where}.{name}", shape)
            for name, term in self.terms.items()
        ]
        return torch.stack(values, dim=1).clamp(min=0.0)
