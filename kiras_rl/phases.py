"""The two phases of KiRAS: skill learning on flat ground, then terrain finetuning.

Each phase is trained by a learner of its own, built from what `phase_config` makes of the run's
configuration. What a phase does not use is not there, and so costs nothing.
"""

from __future__ import annotations

from kiras_rl.config import ConfigError, config_from_layers, config_to_dict
from kiras_rl.schema import Config, TerrainConfig

SKILL_LEARNING, FINETUNING = "skill_learning", "finetuning"


def phases_of(config: Config) -> tuple[str, ...]:
    """Return the phases of a run, in their order."""
    return (SKILL_LEARNING, FINETUNING) if config.finetuning else (SKILL_LEARNING,)


def phase_config(config: Config, phase: str) -> Config:
    """Return the configuration of one phase alone; `iterations` is its length.

    Skill learning is the run without finetuning. Finetuning has the changes that the run asks for
    and no self-imitation: neither a discriminator nor the critic of its reward. What the run leaves
    out of the learner stays out.

    Raises:
        ConfigError: A change of finetuning to a key that does not exist, or of the wrong type.
    """
    values = config_to_dict(config)
    if phase == SKILL_LEARNING or config.finetuning is None:
        return config_from_layers([values, {"finetuning": None}], "the saved configuration")
    finetuning = config.finetuning
    left_out = {name for name, part in values["learner"].items() if part is None}
    changes = {
        "sim": finetuning.sim,
        "env": finetuning.env,
        "learner": {k: v for k, v in finetuning.learner.items() if k not in left_out},
    }
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


def finetuning_terrain(config: Config) -> TerrainConfig:
    """Return the terrain of a run's finetuning.

    Raises:
        ConfigError: There is none, or as `phase_config`.
    """
    terrain = phase_config(config, FINETUNING).env.terrain
    if terrain is None:
        raise ConfigError(
            "finetuning.env.terrain=null: finetuning needs terrain, or set finetuning=null"
        )
    return terrain


def total_iterations(config: Config) -> int:
    """Return the iterations of all phases, T1 + T2."""
    return config.iterations + (config.finetuning.iterations if config.finetuning else 0)


def rsl_rl_config(config: Config, phase: str, step_dt: float) -> dict:
    """Return the dictionary with which rsl-rl's runner builds the learner of a phase.

    Args:
        config: The run, all its phases.
        phase: Which one.
        step_dt: Duration of a control step, s.
    """
    alone = phase_config(config, phase)
    finetuning = config.finetuning if phase == FINETUNING else None
    return {
        "algorithm": {"class_name": alone.learner.class_name},
        "learner": alone.learner,
        "iterations": alone.iterations,
        "retention": finetuning.retention if finetuning else None,
        "reward_scale": step_dt if alone.env.rewards.scale_by_dt else 1.0,
        "num_steps_per_env": alone.learner.ppo.num_steps,
        "save_interval": 0,
    }
