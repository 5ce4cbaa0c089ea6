"""What the values of a configuration must be beyond their types."""

from __future__ import annotations

from typing import Any

from kiras_rl.schedules import piecewise_linear

POSITIVE = (
    "num_envs",
    "iterations",
    "sim.timestep",
    "sim.substeps",
    "env.observations.history_length",
    "env.terminations.episode_length",
    "env.randomization.push_interval",
    "env.terrain.levels",
    "env.terrain.variants",
    "env.terrain.scale",
    "env.terrain.cell",
    "learner.ppo.num_steps",
    "learner.ppo.num_epochs",
    "learner.ppo.num_mini_batches",
    "learner.imitation.discriminator.updates",
    "learner.imitation.discriminator.batch_size",
    "learner.imitation.premium.capacity",
    "learner.imitation.premium.per_iteration",
    "learner.estimator.epochs",
    "evaluation.worlds_per_skill",
    "finetuning.iterations",
)

SCHEDULES = (
    "learner.ppo.action_std",
    "learner.ppo.desired_kl",
    "learner.imitation.discriminator.noise",
)


def find_mistake(values: dict) -> str | None:
    """Return what is wrong with the values of a whole configuration, or None.

    Args:
        values: Nested plain values; a part that is null is not looked at.
    """
    for key in POSITIVE:
        value = _select(values, key)
        if value is not None and not value > 0:
            return f"{key}={value}: must be positive"
    for key in SCHEDULES:
        value = _select(values, key)
        if value is not None and not _is_schedule(value):
            return f"{key}={value}: give [fraction of T1, value] points in ascending order"
    noise = values["learner"]["ppo"]["action_std"]
    if not all(std > 0 for _, std in noise):
        return f"learner.ppo.action_std={noise}: every value must be positive"
    batches, steps = values["learner"]["ppo"]["num_mini_batches"], _rollout(values)
    if batches > steps:
        return (
            f"learner.ppo.num_mini_batches={batches}: at most the {steps} steps of a rollout "
            "(num_envs * learner.ppo.num_steps)"
        )
    return None


def _rollout(values: dict) -> int:
    return values["num_envs"] * values["learner"]["ppo"]["num_steps"]


def _is_schedule(points: list) -> bool:
    try:
        piecewise_linear(points, 0.0)
    except ValueError:
        return False
    return all(len(point) == 2 for point in points)


def _select(values: dict, key: str) -> Any:
    """Return the value at a dotted key, None below a part that is null."""
    for part in key.split("."):
        if values is None:
            return None
        values = values[part]
    return values
