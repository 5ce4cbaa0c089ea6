"""Skill Initialization: practise what the task critic thinks little of."""

from __future__ import annotations

import torch

from kiras_rl.algorithms.part import Part, Setting
from kiras_rl.config import ConfigError
from kiras_rl.schema import SkillInitConfig


def skill_probabilities(values: torch.Tensor, floor: float) -> torch.Tensor:
    """Return p_i = (1 - V_i / sum V) / (S - 1), made safe.

    The paper's formula needs positive values: a negative sum turns the ranking round. Values are
    therefore shifted by their minimum when it is negative, and no probability falls below `floor`:
    what the others have above it pays. For positive values and no p_i under the floor this is the
    paper's formula.

    Args:
        values: Task values of the skills at their keyframes, (S,).
        floor: Least probability.

    Returns:
        Probabilities, (S,), summing to 1.
    """
    lowest = values.min().clamp(max=0.0)
    spread = values.max() - values.min()
    shifted = values - lowest + torch.where(lowest < 0, 1e-3 * spread, 0.0)
    total = shifted.sum()
    share = torch.where(total > 0, shifted / total.clamp(min=1e-12), 1.0 / len(values))
    excess = ((1.0 - share) / (len(values) - 1) - floor).clamp(min=0.0)
    return floor + excess * ((1.0 - len(values) * floor) / excess.sum().clamp(min=1e-12))


def cover_all_skills(probabilities: torch.Tensor, practised: torch.Tensor) -> torch.Tensor:
    """Give a skill that nobody practised the chance of the most practised one.

    Args:
        probabilities: (S,).
        practised: Steps of each skill in the last rollout, (S,).
    """
    most = probabilities[practised.argmax()]
    covered = torch.where(practised == 0, torch.maximum(most, probabilities), probabilities)
    return covered / covered.sum()


class SkillSampler(Part):
    """The probabilities with which the environment draws skills, renewed once an iteration."""

    probabilities: torch.Tensor

    def __init__(self, config: SkillInitConfig, num_skills: int, device: str) -> None:
        """Begin uniform.

        Raises:
            ConfigError: A floor that all skills together cannot have.
        """
        if num_skills > 1 and config.floor * num_skills > 1:
            raise ConfigError(
                f"learner.skill_init.floor={config.floor}: with {num_skills} skills at most "
                f"{1 / num_skills:.3f}"
            )
        self._config = config
        self.probabilities = torch.full((num_skills,), 1.0 / num_skills, device=device)

    @classmethod
    def build(cls, config: SkillInitConfig, setting: Setting) -> SkillSampler:
        """Build for the skills of an environment.

        Raises:
            ConfigError: A floor that all skills together cannot have.
        """
        return cls(config, len(setting.env.skills), setting.device)

    def choose_skills(self, values: torch.Tensor, practised: torch.Tensor) -> None:
        """Renew the probabilities from task values (S,) and practised steps (S,)."""
        if len(values) > 1:  # with one skill there is nothing to choose
            new = skill_probabilities(values, self._config.floor)
            keep = self._config.smoothing
            mixed = keep * self.probabilities + (1.0 - keep) * new
            self.probabilities = cover_all_skills(mixed, practised)

    def begin_from(self, networks: dict[str, dict], state: dict) -> None:
        """Go on with the probabilities of the phase before."""
        if state:
            self.load_state_dict(state)

    def state_dict(self) -> dict:
        """Return the probabilities."""
        return {"probabilities": self.probabilities}

    def load_state_dict(self, state: dict) -> None:
        """Take saved probabilities."""
        self.probabilities = state["probabilities"].to(self.probabilities.device)
