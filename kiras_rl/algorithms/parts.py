"""What a learner is made of, built for the observations of an environment."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from tensordict import TensorDict

from kiras_rl import interfaces as names
from kiras_rl.algorithms.estimation import Estimation
from kiras_rl.algorithms.part import Part, Setting
from kiras_rl.algorithms.residual import Reference
from kiras_rl.algorithms.storage import GroupRolloutStorage
from kiras_rl.classes import find_class
from kiras_rl.config import ConfigError, read_block
from kiras_rl.imitation.self_imitation import SelfImitation
from kiras_rl.interfaces import SkillEnv
from kiras_rl.models.actor import Actor
from kiras_rl.models.critics import GroupCritic
from kiras_rl.models.exported import ExportedPolicy
from kiras_rl.models.precision import uses_bfloat16
from kiras_rl.schema import LearnerConfig
from kiras_rl.skills import SkillSampler

KIRAS: dict[str, type[Part]] = {
    "estimator": Estimation,
    "imitation": SelfImitation,
    "skill_init": SkillSampler,
}
"""Parts by the blocks of `learner` that configure them; null leaves one out."""

RETENTION = "retention"
"""The part that `finetuning.retention` configures."""


@dataclass(frozen=True)
class Learner:
    """What KirasPPO is made of.

    Attributes:
        actor: Its input is proprio and the context, or the history where no part adds a context.
        critic: One network a reward group.
        storage: Of a rollout.
        parts: By name, in the order in which they are asked.
        policy: Actor and what the robot needs beside it, sharing their weights.
    """

    actor: Actor
    critic: GroupCritic
    storage: GroupRolloutStorage
    parts: dict[str, Part]
    policy: ExportedPolicy


def build_learner(obs: TensorDict, env: SkillEnv, cfg: dict, device: str) -> Learner:
    """Build networks, storage and parts.

    Args:
        obs: A first observation.
        env: The environment.
        cfg: rsl-rl's dictionary; `learner` holds the LearnerConfig, `iterations` is the length of
            the phase, `retention` holds its RetentionConfig, None in a phase without a reference,
            `reward_scale` the factor of all rewards of a step.
        device: Where networks and storage live.

    Raises:
        ConfigError: A part that does not exist or does not take its values.
    """
    config: LearnerConfig = cfg["learner"]
    half = uses_bfloat16(config.precision, device)
    setting = Setting(obs, env, config, device, half, cfg["reward_scale"])
    parts = dict(_build_parts(setting, cfg[RETENTION]))
    for part in parts.values():
        obs = TensorDict({**obs, **part.groups(obs)}, batch_size=obs.batch_size)
    groups = {
        "actor": [names.PROPRIO, names.CONTEXT if names.CONTEXT in obs else names.HISTORY],
        "critic": [names.CRITIC],
    }
    count = 1 + len(reward_groups(parts)) if config.multi_critic else 1
    steps = config.ppo.num_steps
    storage = GroupRolloutStorage(env.num_envs, steps, count, obs, env.num_actions, device)
    dims, std = config.ppo.actor_dims, config.ppo.action_std[0][1]
    actor = Actor(obs, groups, env.num_actions, list(dims), std).to(device)
    onboard = [network for part in parts.values() if (network := part.onboard())]
    policy = ExportedPolicy(onboard[0] if onboard else None, actor.mlp)
    for part in parts.values():
        part.meet(policy)
    critic = GroupCritic(obs, groups, count, list(config.ppo.critic_dims), half).to(device)
    return Learner(actor, critic, storage, parts, policy)


def reward_groups(parts: dict[str, Part]) -> list[Part]:
    """Return the parts that bring a reward of their own."""
    return [part for part in parts.values() if part.reward_group]


def _build_parts(setting: Setting, retention: Any) -> Iterator[tuple[str, Part]]:
    """Yield name and part of every block that is configured."""
    config = setting.config
    for name, kind in KIRAS.items():
        if (block := getattr(config, name)) is not None:
            yield name, kind.build(block, setting)
    for name, values in config.parts.items():
        if values is not None:
            yield name, _build_named(f"learner.parts.{name}", dict(values), setting)
    if retention is not None:
        yield RETENTION, Reference.build(retention, setting)


def _build_named(where: str, block: dict[str, Any], setting: Setting) -> Part:
    kind = find_class(f"{where}.class_name", block.pop("class_name", None), Part)
    if kind.settings is not None:
        return kind.build(read_block(where, kind.settings, block), setting)
    try:
        return kind.build(block, setting)
    except (TypeError, KeyError) as error:
        raise ConfigError(
            f"{where}={block}: {kind.__name__} does not take this: {error}"
        ) from error
