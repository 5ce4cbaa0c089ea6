"""CaT, constraints as terminations: a violated constraint ends the episode with a probability.

Chane-Sane et al., IROS 2024, arXiv 2403.18765. Of the violations c_i >= 0 of a step, with running
maxima c_i^max over the worlds, its probability to end is

    delta = max_i p_i clip(c_i / c_i^max, 0, 1),

and nothing is drawn: the reward is max((1 - delta) r, 0), and what comes after counts 1 - delta in
values and advantages. Hard constraints have p = 1; p of soft ones is 1 / steps, and grows over the
phase.

Letters: T steps, N worlds, C constraints.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from kiras_rl import interfaces as names
from kiras_rl.algorithms.part import Outcome, Part, Setting
from kiras_rl.algorithms.storage import GroupRolloutStorage
from kiras_rl.config import ConfigError
from kiras_rl.limits import limited
from kiras_rl.schedules import piecewise_linear

LEAST_MAXIMUM = 1e-6
"""Of a running maximum, in the unit of its constraint; divided by."""


@dataclass
class CatConfig:
    """Keys of the part.

    Attributes:
        decay: Of the running maxima, a step.
        soft: 1 / p of a soft constraint, as [share of the phase, steps].
        fixed: p of the others by name, 1 for a hard one; null makes one soft.
        flat_only: Names of those that hold on flat ground alone.
    """

    decay: float = field(metadata=limited(0, 1))
    soft: list[list[float]]
    fixed: dict[str, float | None]
    flat_only: list[str]


def update_maxima(maxima: torch.Tensor, violations: torch.Tensor, decay: float) -> torch.Tensor:
    """Return the running maxima, (C,), that follow on a step.

    Args:
        maxima: Before it, (C,), each in the unit of its constraint; 0 before the first step, whose
            maxima are taken as they are.
        violations: Of the step, (N, C).
        decay: How much of the maxima stays.
    """
    most = violations.amax(dim=0).clamp(min=LEAST_MAXIMUM)
    return torch.where(maxima > 0.0, decay * maxima + (1.0 - decay) * most, most)


def termination(
    violations: torch.Tensor, maxima: torch.Tensor, probability: torch.Tensor
) -> torch.Tensor:
    """Return delta, (N,), the probability that a step ends its episode.

    Args:
        violations: (N, C), at least 0.
        maxima: What a violation has to reach for the whole of p, (C,), above 0.
        probability: p of each constraint, (C,) or (N, C).
    """
    return (probability * (violations / maxima).clamp(0.0, 1.0)).amax(dim=-1)


class ConstraintsAsTerminations(Part):
    """Running maxima, probabilities, and what they make of rewards and ends."""

    settings = CatConfig

    def __init__(self, config: CatConfig, constraints: tuple[str, ...], device: str) -> None:
        """Begin without maxima.

        Args:
            config: The block.
            constraints: Names of what the environment measures, C.
            device: Of the rollout.

        Raises:
            ConfigError: No constraints, a name that is none of them, or values that cannot be.
        """
        _check(config, constraints)
        self.config, self._names = config, constraints
        fixed = [config.fixed.get(name) for name in constraints]
        self._is_soft = torch.tensor([p is None for p in fixed], device=device)
        self._fixed = torch.tensor([p or 0.0 for p in fixed], device=device)
        anywhere = [name not in config.flat_only for name in constraints]
        self._holds_anywhere = torch.tensor(anywhere, device=device)
        self.maxima = torch.zeros(len(constraints), device=device)
        self.probability = self._fixed.clone()
        self._violated = torch.zeros(len(constraints), device=device)  # shares, summed over steps
        self._ended = torch.zeros((), device=device)  # mean delta, summed over steps
        self.set_progress(0.0)

    @classmethod
    def build(cls, config: CatConfig, setting: Setting) -> ConstraintsAsTerminations:
        """Build for the constraints of an environment.

        Raises:
            ConfigError: No constraints, a name that is none of them, or values that cannot be.
        """
        return cls(config, setting.env.constraints, setting.device)

    def set_progress(self, progress: float) -> None:
        """Set p of the soft constraints to its value at this share of the phase."""
        soft = 1.0 / piecewise_linear(self.config.soft, progress)
        self.probability.copy_(torch.where(self._is_soft, soft, self._fixed))  # a graph reads it

    def record(self, rollout: GroupRolloutStorage, step: Outcome) -> dict[str, torch.Tensor]:
        """Scale the reward by what is left of the episode, and end the rest; all in place."""
        holds = self._holds_anywhere | step.extras[names.EXTRA_FLAT][:, None]
        violations = step.extras[names.EXTRA_CONSTRAINTS] * holds
        self.maxima.copy_(update_maxima(self.maxima, violations, self.config.decay))
        delta = termination(violations, self.maxima, self.probability)
        self._violated += (violations > 0.0).float().mean(dim=0)
        self._ended += delta.mean()
        # A fall is an end with certainty. One by the clock is none: its reward is whole.
        fell = step.dones.bool() & ~step.extras[names.EXTRA_TIME_OUTS]
        left = 1.0 - torch.maximum(delta, fell.float())
        step.rewards = (left * step.rewards).clamp(min=0.0)
        step.dones = torch.maximum(delta, step.dones.float())
        return {}

    def describe(self, rollout: GroupRolloutStorage) -> dict[str, float]:
        """Return the mean of delta, the share of steps that violate each constraint, and maxima."""
        steps = rollout.num_transitions_per_env
        violated, maxima = (self._violated / steps).tolist(), self.maxima.tolist()
        scalars = {"CaT/termination": self._ended.item() / steps}
        for name, share, most in zip(self._names, violated, maxima, strict=True):
            scalars |= {f"CaT/violated_{name}": share, f"CaT/maximum_{name}": most}
        self._violated.zero_()
        self._ended.zero_()
        return scalars

    def begin_from(self, networks: dict[str, dict], state: dict) -> None:
        """Begin the next phase: on other ground the first maxima are taken anew."""

    def state_dict(self) -> dict:
        """Return the running maxima."""
        return self.world_state()

    def load_state_dict(self, state: dict) -> None:
        """Go on with saved maxima."""
        self.load_world_state(state)

    def world_state(self) -> dict:
        """Return the maxima, which are over the worlds of this rank alone."""
        return {"maxima": self.maxima}

    def load_world_state(self, state: dict) -> None:
        """Go on with the maxima of this rank."""
        self.maxima.copy_(state["maxima"])


def _check(config: CatConfig, constraints: tuple[str, ...]) -> None:
    """Refuse what cannot be.

    Raises:
        ConfigError: See above.
    """
    if not constraints:
        raise ConfigError("env.constraints: none, of which terminations could be made")
    known = ", ".join(constraints)
    for key, given in (("fixed", config.fixed), ("flat_only", config.flat_only)):
        for name in given:
            if name not in constraints:
                raise ConfigError(f"{key}: no '{name}' in env.constraints, configured: {known}")
    for name, p in config.fixed.items():
        if p is not None and not 0.0 <= p <= 1.0:
            raise ConfigError(f"fixed.{name}={p}: allowed are 0 to 1")
    shares = [point[0] for point in config.soft if len(point) == 2]
    if not shares or len(shares) < len(config.soft) or shares != sorted(shares):
        raise ConfigError(f"soft={config.soft}: give [share of the phase, steps], in their order")
    if min(steps for _, steps in config.soft) < 1.0:
        raise ConfigError(f"soft={config.soft}: steps are 1 / p, at least 1")
