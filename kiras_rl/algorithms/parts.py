"""The parts of a learner, built for the observations of an environment."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import nn

from kiras_rl import interfaces as names
from kiras_rl.algorithms.estimation import Estimation
from kiras_rl.algorithms.residual import Reference
from kiras_rl.algorithms.storage import GroupRolloutStorage
from kiras_rl.imitation.self_imitation import SelfImitation
from kiras_rl.interfaces import SkillEnv
from kiras_rl.models.critics import GroupCritic
from kiras_rl.models.exported import ExportedPolicy
from kiras_rl.models.precision import uses_bfloat16
from kiras_rl.schema import LearnerConfig
from kiras_rl.skills import SkillSampler


@dataclass(frozen=True)
class Parts:
    """What KirasPPO is made of; None is a part that the configuration leaves out.

    Attributes:
        actor: Its input is proprio and the context, or the history without an estimator.
        critic: One network a reward group.
        storage: Of a rollout.
        imitation: Discriminator and premium trajectories.
        estimation: The context estimator.
        sampler: Of the skills.
        reference: The policy of the phase before.
    """

    actor: MLPModel
    critic: GroupCritic
    storage: GroupRolloutStorage
    imitation: SelfImitation | None
    estimation: Estimation | None
    sampler: SkillSampler | None
    reference: Reference | None


def build_parts(obs: TensorDict, env: SkillEnv, cfg: dict, device: str) -> Parts:
    """Build networks, storage and statistics.

    Args:
        obs: A first observation; gains the groups that the learner itself writes.
        env: The environment.
        cfg: rsl-rl's dictionary; `learner` holds the LearnerConfig, `iterations` is the length of
            the phase, `retention` holds its RetentionConfig, None in a phase without a reference,
            `reward_scale` the factor of all rewards of a step.
        device: Where networks and storage live.
    """
    config: LearnerConfig = cfg["learner"]
    ppo, retention = config.ppo, cfg["retention"]
    half = uses_bfloat16(config.precision, device)
    estimation = Estimation.build(config.estimator, obs, env, device)
    if estimation:
        obs[names.CONTEXT] = estimation.context(obs)
    obs[names.NEXT_PROPRIO] = torch.zeros_like(obs[names.PROPRIO])
    if retention is not None:
        obs[names.FLAT_ACTION] = torch.zeros(len(obs), env.num_actions, device=device)
        obs[names.IS_FLAT] = torch.zeros(len(obs), 1, dtype=torch.bool, device=device)
    imitation = SelfImitation.build(config.imitation, obs, env, ppo.num_steps, half, device)
    groups = {
        "actor": [names.PROPRIO, names.CONTEXT if estimation else names.HISTORY],
        "critic": [names.CRITIC],
    }
    count = 2 if imitation is not None and config.multi_critic is not None else 1
    storage = GroupRolloutStorage(env.num_envs, ppo.num_steps, count, obs, env.num_actions, device)
    sampler = (
        SkillSampler(config.skill_init, len(env.skills), device) if config.skill_init else None
    )
    actor = _build_actor(obs, groups, env.num_actions, config).to(device)
    reference = None
    if retention is not None:
        policy = ExportedPolicy(estimation.estimator if estimation else None, actor.mlp)
        reference = Reference(policy, retention, cfg["reward_scale"])
    critic = GroupCritic(obs, groups, count, list(ppo.critic_dims), half).to(device)
    return Parts(actor, critic, storage, imitation, estimation, sampler, reference)


def _build_actor(
    obs: TensorDict, groups: dict[str, list[str]], num_actions: int, config: LearnerConfig
) -> MLPModel:
    distribution = {
        "class_name": "GaussianDistribution",
        "init_std": config.ppo.action_std[0][1],
        "learn_std": False,
    }
    actor = MLPModel(
        obs, groups, "actor", num_actions, list(config.ppo.actor_dims), "elu", False, distribution
    )
    # First actions near zero: the robot begins in its default pose, not in a random one.
    nn.init.normal_(actor.mlp[-1].weight, std=0.01)
    nn.init.zeros_(actor.mlp[-1].bias)
    return actor
