"""The phases of a run: skill learning on flat ground, then terrain finetuning.

`plan` resolves a run's configuration once. A `Phase` is what everything after it takes: it holds a
configuration of its own. What the phase does not use is not there, and so costs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

from kiras_rl.config import ConfigError, config_from_layers, config_to_dict
from kiras_rl.schema import Config, RetentionConfig, TerrainConfig

SKILL_LEARNING, FINETUNING = "skill_learning", "finetuning"


@dataclass(frozen=True)
class Phase:
    """One phase of a run; not to be changed, nor are its configurations.

    Attributes:
        name: What checkpoints call it.
        run: Configuration of the whole run.
        config: Configuration of this phase alone; `iterations` is its length.
        first: Iterations of the run before it.
        retention: What holds the skills of the phase before; None where there is none.
    """

    name: str
    run: Config
    config: Config
    first: int = 0
    retention: RetentionConfig | None = None

    @property
    def last(self) -> int:
        """Iterations of the run when it is over."""
        return self.first + self.config.iterations

    def learner_settings(self, step_dt: float) -> dict:
        """Return the dictionary with which rsl-rl's runner builds the learner.

        Args:
            step_dt: Duration of a control step, s.
        """
        return {
            "algorithm": {"class_name": self.config.learner.class_name},
            "learner": self.config.learner,
            "iterations": self.config.iterations,
            "retention": self.retention,
            "reward_scale": step_dt if self.config.env.rewards.scale_by_dt else 1.0,
            "num_steps_per_env": self.config.learner.ppo.num_steps,
            "save_interval": 0,
        }


def plan(run: Config) -> list[Phase]:
    """Return the phases of a run, in their order.

    Raises:
        ConfigError: A change of finetuning to a key that does not exist, or of the wrong type.
    """
    phases = [Phase(SKILL_LEARNING, run, _skill_learning(run))]
    if run.finetuning is not None:
        retention = run.finetuning.retention
        phases += [Phase(FINETUNING, run, _finetuning(run), phases[-1].last, retention)]
    return phases


def phase_of(run: Config, name: str) -> Phase:
    """Return one phase of a run.

    Raises:
        ConfigError: The run has no such phase, or as `plan`.
    """
    for phase in plan(run):
        if phase.name == name:
            return phase
    raise ConfigError(f"{name}=null: this run has no phase of {name}")


def finetuning_terrain(run: Config) -> TerrainConfig:
    """Return the terrain of a run's finetuning.

    Raises:
        ConfigError: There is none, or as `plan`.
    """
    terrain = phase_of(run, FINETUNING).config.env.terrain
    if terrain is None:
        raise ConfigError(
            "finetuning.env.terrain=null: finetuning needs terrain, or set finetuning=null"
        )
    return terrain


def total_iterations(run: Config) -> int:
    """Return the iterations of all phases, T1 + T2."""
    return run.iterations + (run.finetuning.iterations if run.finetuning else 0)


def _skill_learning(run: Config) -> Config:
    """Return the run without finetuning."""
    layers = [config_to_dict(run), {"finetuning": None}]
    return config_from_layers(layers, "the saved configuration")


def _finetuning(run: Config) -> Config:
    """Return the run with the changes that finetuning asks for.

    It has no self-imitation: neither a discriminator nor the critic of its reward. What the run
    leaves out of the learner stays out.
    """
    finetuning, values = run.finetuning, config_to_dict(run)
    assert finetuning is not None
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
