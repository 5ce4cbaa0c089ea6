"""What the values of a configuration must be beyond their types."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any

from kiras_rl.limits import SCHEDULES, find_outside

RANGES = (
    "env.commands.lin_vel_x",
    "env.commands.lin_vel_y",
    "env.commands.ang_vel_z",
    "env.randomization.friction",
    "env.randomization.payload",
    "env.randomization.com_shift",
    "env.randomization.kp_factor",
    "env.randomization.kd_factor",
    "env.randomization.motor_factor",
    "env.randomization.torque_factor",
    "env.randomization.leg_mass_factor",
    "env.randomization.joint_friction_factor",
    "env.randomization.joint_damping_factor",
    "env.randomization.encoder_bias",
    "env.randomization.imu_tilt",
    "env.randomization.gyro_bias",
    "env.randomization.observation_delay",
    "env.randomization.action_delay",
    "env.randomization.push_velocity",
    "env.terrain.task.lin_vel_x",
    "learner.ppo.learning_rate_range",
    "evaluation.terrain.command",
)
"""[low, high]. Pairs of terrain are no ranges: from the lowest to the top level they may fall."""

POINTS = "[share of the phase, value] points in ascending order"
"""What a schedule is."""

NOT_EMPTY = ("learner.ppo.actor_dims", "learner.ppo.critic_dims")

TERMS = {
    "env.observations.proprio": ("scale", "noise"),
    "env.observations.critic": ("scale", "noise"),
    "env.observations.imitation": ("scale", "noise"),
    "env.rewards.terms": ("weight",),
    "env.terrain.types": ("proportion",),
}
"""Lists of terms, and the keys that hold a number in each of their entries."""


def find_mistake(values: dict) -> str | None:
    """Return what is wrong with the values of a whole configuration, or None.

    Of the changes that finetuning makes only the numbers are looked at: kiras_rl.phases merges them
    into a whole configuration, which is looked at in full.

    Args:
        values: Nested plain values; a part that is null is not looked at.
    """
    checks = (
        _find_infinite,  # what the others compare is finite
        _find_disorder,
        find_outside,
        _find_empty,
        _find_no_number,
        _find_large_batches,
        _find_short_episodes,
    )
    return next((mistake for check in checks if (mistake := check(values))), None)


def _find_infinite(values: dict) -> str | None:
    for key, value in _leaves(values):
        if not all(math.isfinite(x) for x in _scalars(value) if isinstance(x, float)):
            return f"{key}={value}: must be finite"
    return None


def _find_disorder(values: dict) -> str | None:
    for key, (low, high) in _given(values, RANGES):
        if low > high:
            return f"{key}={[low, high]}: give [low, high], the lower number first"
    for key, value in _given(values, SCHEDULES):
        if not _is_schedule(value):
            return f"{key}={value}: give {POINTS}"
    return None


def _find_empty(values: dict) -> str | None:
    for key, value in _given(values, NOT_EMPTY):
        if not value:
            return f"{key}={value}: give one number at least"
    for key, terms in _given(values, TERMS):
        if all(entry is None for entry in terms.values()):
            return f"{key}: nothing is left of it; keep one entry at least"
    return None


def _find_no_number(values: dict) -> str | None:
    for where, terms in _given(values, TERMS):
        for name, entry in terms.items():
            if not isinstance(entry, dict):
                continue  # null, or refused where the term is looked up
            for key in TERMS[where]:
                if key in entry and (problem := _value_problem(key, entry[key])):
                    shown = "null" if entry[key] is None else repr(entry[key])
                    return f"{where}.{name}.{key}={shown}: {problem}"
    return None


def _value_problem(key: str, value: Any) -> str | None:
    """Return what is wrong with a number of a term, or None; a weight may be a schedule."""
    if key == "weight" and isinstance(value, list):
        return None if _is_schedule(value) else f"give a number or {POINTS}"
    return None if _is_number(value) else "must be a number"


def _find_large_batches(values: dict) -> str | None:
    batches, steps = values["learner"]["ppo"]["num_mini_batches"], _rollout(values)
    if batches > steps:
        return (
            f"learner.ppo.num_mini_batches={batches}: at most the {steps} steps of a rollout "
            "(num_envs * learner.ppo.num_steps)"
        )
    return None


def _find_short_episodes(values: dict) -> str | None:
    length, sim = values["env"]["terminations"]["episode_length"], values["sim"]
    step = sim["timestep"] * sim["substeps"]
    if length < step:
        return (
            f"env.terminations.episode_length={length}: at least the {step:g} s of a control step "
            "(sim.timestep * sim.substeps)"
        )
    return None


def _rollout(values: dict) -> int:
    return values["num_envs"] * values["learner"]["ppo"]["num_steps"]


def _is_schedule(points: list) -> bool:
    pairs = all(isinstance(p, list) and len(p) == 2 and all(map(_is_number, p)) for p in points)
    return pairs and bool(points) and points == sorted(points, key=lambda point: point[0])


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _leaves(values: dict, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield what is no mapping, with its dotted key."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _scalars(value: Any) -> Iterator[Any]:
    """Yield what nested lists hold, or a value that is no list."""
    if isinstance(value, list):
        for item in value:
            yield from _scalars(item)
    else:
        yield value


def _given(values: dict, keys: Iterable[str]) -> Iterator[tuple[str, Any]]:
    """Yield the keys that are not null, with their values."""
    for key in keys:
        value = _select(values, key)
        if value is not None:
            yield key, value


def _select(values: dict, key: str) -> Any:
    """Return the value at a dotted key, None below a part that is null."""
    for part in key.split("."):
        if values is None:
            return None
        values = values[part]
    return values
