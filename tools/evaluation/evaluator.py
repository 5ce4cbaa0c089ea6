"""The evaluation environment of a configuration, and the evaluations beside a training."""

from __future__ import annotations

import copy
from collections.abc import Callable

import torch
from tensordict import TensorDict

from kiras_rl.config import ConfigError, config_from_dict, list_configs, load_config
from kiras_rl.deploy.policy import OnboardPolicy, PolicyMetadata
from kiras_rl.envs import make_env
from kiras_rl.envs.quadruped import QuadrupedEnv
from kiras_rl.envs.terrain_library import build_library
from kiras_rl.evaluation.flat import SETTLE, Policy, SkillResult, evaluate_skills
from kiras_rl.evaluation.terrain import (
    TIME_LIMIT,
    TerrainResult,
    evaluate_terrain,
    rough_types,
)
from kiras_rl.interfaces import HISTORY, PROPRIO
from kiras_rl.phases import Phase, finetuning_terrain, plan
from kiras_rl.robots.robot import Robot, load_robot
from kiras_rl.runner import Evaluators
from kiras_rl.schema import Config


def trained_config(metadata: PolicyMetadata) -> Config:
    """Return the configuration that a policy was trained with.

    Raises:
        ConfigError: If the policy does not say it, or this version cannot read it.
    """
    if "config" not in metadata.provenance:
        raise ConfigError(
            "this policy does not say how it was trained (provenance.config is missing): export it "
            "from its run or checkpoint with kiras-export"
        )
    return config_from_dict(metadata.provenance["config"])


def standard_config(robot: str) -> Config:
    """Return the configuration of a robot's own name, without that of a variant, else `base`."""
    name = robot.partition(":")[0]
    return load_config(name if name in list_configs() else "base")


def evaluation_physics(config: Config, nominal: bool) -> Config:
    """Return a policy's configuration with what is its robot's standard, whatever it trained with.

    That is the randomization, or none, and what counts as a fall.

    Args:
        config: Of one phase; it is changed.
        nominal: No randomization, sensor noise or pushes.
    """
    standard = standard_config(config.robot).env
    config.env.randomization = standard.randomization
    config.env.terminations = standard.terminations
    config.env.observations.noise = not nominal
    config.env.skills = standard.skills
    if nominal:
        for name, value in vars(config.env.randomization).items():
            if name != "push_interval" and value is not None:
                setattr(config.env.randomization, name, None)
    return config


def make_evaluation_env(
    config: Config,
    num_envs: int,
    duration: float,
    device: str = "cpu",
    robot: Robot | None = None,
) -> QuadrupedEnv:
    """Build an environment with the run's physics, in which no trial is cut short.

    Args:
        config: Of one phase.
        num_envs: Worlds.
        duration: Of a trial, s.
        device: Of the simulation.
        robot: The robot, if not the configuration's: a policy's, see `policy_files.robot_of`.
    """
    config = copy.deepcopy(config)
    config.env.terminations.episode_length = duration + 1.0
    config.env.terminations.random_first_length = False
    return make_env(config, device, num_envs, robot)


def make_evaluators(phase: Phase, device: str) -> Evaluators:
    """Return the evaluations that run beside a phase of a training.

    The one on flat ground is the same in both phases: it shows what finetuning forgets.

    Raises:
        ConfigError: A duration that leaves nothing to count.
    """
    if not phase.config.evaluation.interval:
        return Evaluators()
    rough = phase.config if phase.config.env.terrain else None
    return Evaluators(
        flat=_make_flat_evaluator(plan(phase.run)[0].config, device),
        terrain=_make_terrain_evaluator(rough, device) if rough else None,
    )


def _make_flat_evaluator(config: Config, device: str) -> Callable[[Policy], dict[str, SkillResult]]:
    settings = config.evaluation
    if settings.duration <= SETTLE:
        raise ConfigError(
            f"evaluation.duration={settings.duration}: more than the first {SETTLE} s, "
            "which are not counted"
        )
    num_envs = settings.worlds_per_skill * len(load_robot(config.robot).skills)
    env = make_evaluation_env(config, num_envs, settings.duration, device)

    def evaluate(policy: Policy) -> dict[str, SkillResult]:
        return evaluate_skills(env, policy, settings.duration, settings.command)

    return evaluate


def _make_terrain_evaluator(config: Config, device: str) -> Callable[[Policy], TerrainResult]:
    settings, terrain = config.evaluation.terrain, config.env.terrain
    assert terrain is not None  # the caller looked
    count = len(rough_types(build_library(terrain).types))
    num_envs = settings.robots * count * len(load_robot(config.robot).skills)
    env = make_evaluation_env(config, num_envs, TIME_LIMIT, device)

    def evaluate(policy: Policy) -> TerrainResult:
        return evaluate_terrain(env, policy, settings.robots, settings.level, settings.command)

    return evaluate


def check_terrain(config: Config) -> None:
    """Make the terrain of finetuning once.

    Raises:
        ConfigError: If it cannot be, or has no such level as the evaluation asks for.
    """
    terrain, level = finetuning_terrain(config), config.evaluation.terrain.level
    build_library(terrain)
    if not 0 <= level < terrain.levels:
        raise ConfigError(
            f"evaluation.terrain.level={level}: allowed are 0 to {terrain.levels - 1}, see levels "
            "of finetuning.env.terrain"
        )


def onboard_policy(policy: OnboardPolicy) -> Policy:
    """Return observation -> mean actions of a policy file: what is measured is what is deployed."""

    def act(obs: TensorDict) -> torch.Tensor:
        actions, _ = policy.infer(obs[PROPRIO].cpu().numpy(), obs[HISTORY].cpu().numpy())
        return torch.from_numpy(actions).to(obs.device)

    return act
