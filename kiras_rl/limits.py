"""The range of every number of a configuration, by its dotted key; docs/configuration.md shows it.

Of a list every number is in the range; of a schedule, [fraction, value] points, every value.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any

LARGEST = 1e9
"""What a number may be where nothing else bounds it."""

_SEED = 2**63 - 1  # torch takes one bit more, which leaves room for the number of a rank


@dataclass(frozen=True)
class Limits:
    """The least and the largest value; with `above` the least one itself is too little."""

    low: float
    high: float
    above: bool = False

    def __contains__(self, value: float) -> bool:
        """Tell whether a value is allowed."""
        return self.low <= value <= self.high and not (self.above and value == self.low)

    def __str__(self) -> str:
        """Say what is allowed."""
        low, high = _shown(self.low), _shown(self.high)
        return f"above {low}, at most {high}" if self.above else f"{low} to {high}"

    def problem(self, value: float) -> str:
        """Say what is wrong with a value outside."""
        if self.low == 0 and value <= 0:
            if self.above:
                return "must be positive"
            if self.high >= LARGEST and self.high != _SEED:
                return "must not be negative"
        return f"allowed are {self}"


def _shown(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:g}"


_SHARE = Limits(0, 1)
_NOT_NEGATIVE = Limits(0, LARGEST)
_POSITIVE = Limits(0, LARGEST, above=True)
_COUNT = Limits(1, 10**9)
_FACTOR = Limits(0, 10)
_COUNTED = Limits(0, 10**9, above=True)

LIMITS = {
    "seed": Limits(0, _SEED),
    "num_envs": _COUNTED,
    "iterations": _COUNTED,
    "checkpoint_minutes": _NOT_NEGATIVE,
    "sim.threads": Limits(0, 1024),
    "sim.timestep": Limits(0, 0.05, above=True),
    "sim.substeps": Limits(0, 100, above=True),
    "sim.solver_iterations": Limits(1, 1000),
    "sim.max_contacts": Limits(1, 100_000),
    "sim.max_constraints": Limits(1, 100_000),
    "sim.max_ccd": Limits(0, 100_000),
    "env.action_clip": Limits(0, 1000, above=True),
    "env.observations.history_length": Limits(0, 1000, above=True),
    "env.rewards.penalty_scale": _NOT_NEGATIVE,
    "env.rewards.sigma": _POSITIVE,
    "env.commands.lin_vel_x": Limits(-20, 20),
    "env.commands.lin_vel_y": Limits(-20, 20),
    "env.commands.ang_vel_z": Limits(-20, 20),
    "env.commands.zero_probability": _SHARE,
    "env.commands.resample_probability": _SHARE,
    "env.commands.heading_gain": Limits(0, 100),
    "env.skills.switch_probability": _SHARE,
    "env.skills.start_at_target": _SHARE,
    "env.skills.joint_noise": Limits(0, 3),
    "env.skills.velocity_noise": Limits(0, 20),
    "env.terminations.episode_length": _POSITIVE,
    "env.randomized_share": _SHARE,
    "env.randomization.friction": _FACTOR,
    "env.randomization.payload": Limits(-1000, 1000),
    "env.randomization.com_shift": Limits(-10, 10),
    "env.randomization.kp_factor": _FACTOR,
    "env.randomization.kd_factor": _FACTOR,
    "env.randomization.motor_factor": _FACTOR,
    "env.randomization.torque_factor": _FACTOR,
    "env.randomization.leg_mass_factor": _FACTOR,
    "env.randomization.joint_friction_factor": Limits(0, 1000),
    "env.randomization.joint_damping_factor": Limits(0, 1000),
    "env.randomization.encoder_bias": Limits(-10, 10),
    "env.randomization.imu_tilt": Limits(-3.2, 3.2),
    "env.randomization.gyro_bias": Limits(-10, 10),
    "env.randomization.action_delay": Limits(0, 50),
    "env.randomization.observation_delay": Limits(0, 50),
    "env.randomization.push_velocity": Limits(-20, 20),
    "env.randomization.push_interval": _POSITIVE,
    "env.terrain.levels": Limits(0, 1000, above=True),
    "env.terrain.variants": Limits(0, 1000, above=True),
    "env.terrain.scale": Limits(0, 100, above=True),
    "env.terrain.seed": Limits(0, _SEED),
    "env.terrain.cell": Limits(0, 1, above=True),
    "env.terrain.noise": Limits(0, 1),
    "env.terrain.task.lin_vel_x": Limits(-20, 20),
    "env.terrain.task.zero_probability": _SHARE,
    "env.terrain.task.resample_probability": _SHARE,
    "env.terrain.task.heading_probability": _SHARE,
    "env.terrain.task.switch_probability": _SHARE,
    "env.terrain.task.start_at_target": _SHARE,
    "learner.ppo.num_steps": Limits(2, 100_000),
    "learner.ppo.num_epochs": Limits(0, 1000, above=True),
    "learner.ppo.num_mini_batches": _COUNTED,
    "learner.ppo.gamma": _SHARE,
    "learner.ppo.lam": _SHARE,
    "learner.ppo.clip_param": Limits(0, 10, above=True),
    "learner.ppo.value_loss_coef": _NOT_NEGATIVE,
    "learner.ppo.max_grad_norm": _POSITIVE,
    "learner.ppo.learning_rate": _FACTOR,  # at 0 a part does not learn
    "learner.ppo.learning_rate_range": _FACTOR,
    "learner.ppo.desired_kl": _POSITIVE,
    "learner.ppo.action_std": Limits(0, 100, above=True),
    "learner.ppo.actor_dims": Limits(0, 100_000, above=True),
    "learner.ppo.critic_dims": Limits(0, 100_000, above=True),
    "learner.imitation.reward_weight": _NOT_NEGATIVE,
    "learner.imitation.whole_from": _SHARE,
    "learner.imitation.discriminator.hidden_dims": Limits(0, 100_000, above=True),
    "learner.imitation.discriminator.learning_rate": _FACTOR,
    "learner.imitation.discriminator.updates": Limits(0, 100_000, above=True),
    "learner.imitation.discriminator.batch_size": _COUNTED,
    "learner.imitation.discriminator.gradient_penalty": _NOT_NEGATIVE,
    "learner.imitation.discriminator.noise": Limits(0, 1000),
    "learner.imitation.premium.window": Limits(2, 100_000),
    "learner.imitation.premium.capacity": Limits(0, 100_000, above=True),
    "learner.imitation.premium.max_age": _COUNT,
    "learner.imitation.premium.min_command": Limits(0, 20),
    "learner.imitation.premium.min_progress": Limits(0, 10),
    "learner.imitation.premium.max_distance": _POSITIVE,
    "learner.imitation.premium.per_iteration": Limits(0, 100_000, above=True),
    "learner.imitation.premium.keyframe_share": _SHARE,
    "learner.imitation.premium.distance_weight": _NOT_NEGATIVE,
    "learner.multi_critic.sigma": _SHARE,
    "learner.multi_critic.omega2_floor": _SHARE,
    "learner.multi_critic.std_floor": Limits(0, 1000, above=True),
    "learner.estimator.latent_dim": Limits(0, 100_000),  # at 0 the context is the velocity alone
    "learner.estimator.encoder_dims": Limits(0, 100_000, above=True),
    "learner.estimator.decoder_dims": Limits(0, 100_000, above=True),
    "learner.estimator.relative_step": _NOT_NEGATIVE,
    "learner.estimator.epochs": Limits(0, 1000, above=True),
    "learner.estimator.kl_weight": _NOT_NEGATIVE,
    "learner.estimator.prior_weight": _NOT_NEGATIVE,
    "learner.estimator.adaboot_floor": _SHARE,
    "learner.skill_init.floor": _SHARE,  # what S skills can have is checked with them
    "learner.skill_init.smoothing": Limits(0, 0.9999),
    "finetuning.iterations": _COUNTED,
    "finetuning.retention.residual_weight": _NOT_NEGATIVE,
    "finetuning.retention.flat_loss_weight": _NOT_NEGATIVE,
    "evaluation.interval": Limits(0, 10**9),
    "evaluation.worlds_per_skill": Limits(0, 100_000, above=True),
    "evaluation.duration": Limits(0, 3600, above=True),
    "evaluation.command": Limits(-20, 20),
    "evaluation.terrain.robots": Limits(0, 100_000, above=True),
    "evaluation.terrain.level": Limits(0, 1000),
    "evaluation.terrain.command": Limits(-20, 20),
}
"""By key, in the order of the schema."""

PARAMETERS = {
    "env.observations.proprio": {"noise": _NOT_NEGATIVE},
    "env.observations.critic": {"noise": _NOT_NEGATIVE},
    "env.observations.imitation": {"noise": _NOT_NEGATIVE},
    "env.rewards.terms": {
        "weight": Limits(-1e6, 1e6),
        "sigma": _POSITIVE,
        "threshold": _NOT_NEGATIVE,
        "largest": _NOT_NEGATIVE,
        "lateral": _NOT_NEGATIVE,
        "height": Limits(-10, 10),
        "target": Limits(0, 60),
    },
    "env.terminations.terms": {"force": _NOT_NEGATIVE, "angle": Limits(0, 180, above=True)},
    "env.terrain.types": {"proportion": Limits(0, 1e6)},
}
"""Of the terms of a group, by the name of their parameter."""

_ANY = Limits(-LARGEST, LARGEST)


def limited(low: float, high: float, above: bool = False) -> dict[str, Limits]:
    """Return the metadata of a dataclass field that holds numbers within limits."""
    return {"limits": Limits(low, high, above)}


SCHEDULES = (
    "env.rewards.penalty_scale",
    "env.randomized_share",
    "learner.ppo.action_std",
    "learner.ppo.desired_kl",
    "learner.imitation.whole_from",
    "learner.imitation.discriminator.noise",
)
"""Lists of [fraction of T1, value]."""


def find_outside(values: dict) -> str | None:
    """Return which value of a whole configuration is outside of its range, or None.

    Args:
        values: Nested plain values; what is null is not looked at.
    """
    return next(_outside(values), None)


def find_outside_fields(block: Any, where: str) -> str | None:
    """Return which field of a dataclass is outside of its `limited` range, or None.

    Args:
        block: Its fields hold numbers, or lists of them, where they are limited.
        where: The key of the configuration that holds the block.
    """
    for field in fields(block):
        if limits := field.metadata.get("limits"):
            value = getattr(block, field.name)
            found = _check(f"{where}.{field.name}", value, _numbers(value), limits)
            if problem := next(found, None):
                return problem
    return None


def _outside(values: dict, prefix: str = "") -> Iterator[str]:
    for name, value in values.items():
        key = f"{prefix}{name}"
        if key in PARAMETERS and value:
            yield from _outside_terms(key, value)
        elif isinstance(value, dict):
            yield from _outside(value, f"{key}.")
        elif key in LIMITS and value is not None:
            numbers = [point[1] for point in value] if key in SCHEDULES else _numbers(value)
            yield from _check(key, value, numbers, LIMITS[key])


def _outside_terms(group: str, terms: dict) -> Iterator[str]:
    for name, entry in terms.items():
        for parameter, value in entry.items() if isinstance(entry, dict) else ():
            key = f"{group}.{name}.{parameter}"
            yield from _check(key, value, _numbers(value), PARAMETERS[group].get(parameter, _ANY))
            if parameter == "scale" and value == 0:
                yield f"{key}={value}: must not be 0; null in place of the term removes it"


def _check(key: str, shown: Any, numbers: Iterator[Any] | list, limits: Limits) -> Iterator[str]:
    for number in numbers:
        if isinstance(number, int | float) and number not in limits:
            yield f"{key}={shown}: {limits.problem(number)}"
            return


def _numbers(value: Any) -> Iterator[Any]:
    """Yield what nested lists hold, or a value that is no list."""
    if isinstance(value, list):
        for item in value:
            yield from _numbers(item)
    else:
        yield value
