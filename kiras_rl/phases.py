"""The two phases of KiRAS: skill learning on flat ground, then terrain finetuning.

Each phase is trained by a learner of its own, built from what `phase_config` makes of the run's
configuration. What a phase does not use is not there, and so costs nothing.
"""

from __future__ import annotations

from kiras_rl.config import ConfigError, config_from_layers, config_to_dict
from kiras_rl.schema import Config

SKILL_LEARNING, FINETUNING = "skill_learning", "finetuning"


def phases_of(config: Config) -> tuple[str, ...]:
    """Return the phases of a run, in their order."""
    return (SKILL_LEARNING, FINETUNING) if config.finetuning else (SKILL_LEARNING,)


def phase_config(config: Config, phase: str) -> Config:
    """Return the configuration of one phase alone; `iterations` is its length.

    Skill learning is the run without finetuning. Finetuning has the changes that the run asks for
    and no self-imitation: neither a discriminator nor the critic of its reward.

    Raises:
        ConfigError: A change of finetuning to a key that does not exist, or of the wrong type.
    """
    values = config_to_dict(config)
    if phase == SKILL_LEARNING or config.finetuning is None:
        return config_from_layers([values, {"finetuning": None}], "the saved configuration")
    finetuning = config.finetuning
    changes = {name: getattr(finetuning, name) for name in ("sim", "env", "learner")}
    alone = {
        "iterations": finetuning.iterations,
        "learner": {"imitation": None, "multi_critic": None},
        "finetuning": None,
    }
    try:
        return config_from_layers([values, changes, alone], "finetuning")
    except ConfigError as error:
        where = "" if str(error).startswith("finetuning") else "finetuning: "
        raise ConfigError(f"{where}{error}") from None


def total_iterations(config: Config) -> int:
    """Return the iterations of all phases, T1 + T2."""
    return config.iterations + (config.finetuning.iterations if config.finetuning else 0)
