"""Walk These Ways: a trot by the clock, commanded behaviour, and what the history tells of physics.

Margolis and Agrawal, CoRL 2022, arXiv 2212.03238. With theta the turn of a foot, in [0, 1), a foot
shall stand in the first half, which is smoothed by the normal distribution Phi of deviation kappa,

    C(theta) = Phi(theta) (1 - Phi(theta - 1/2)) + Phi(theta - 1) (1 - Phi(theta - 3/2)).

Force in swing and velocity in stance cost sum (1 - C)(1 - exp(-F^2 / s)) / 4 and
sum C (1 - exp(-v^2 / s)) / 4; a reward is r+ exp(r- / sigma), of the sums of positive and negative
terms (env.rewards.sigma). The adaptation module says of the history what a robot cannot measure, by
the mean squared error.

Letters: N worlds, B rows, F feet, H past frames, P numbers a frame, K properties of the physics.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch

from kiras_rl import interfaces as names
from kiras_rl.algorithms.estimation import VELOCITY_SCALE, Told
from kiras_rl.algorithms.part import Iteration, Setting
from kiras_rl.algorithms.storage import GroupRolloutStorage
from kiras_rl.config import ConfigError
from kiras_rl.deploy.gaits import TROT, trot_behaviour, trot_clock
from kiras_rl.deploy.terms import observed
from kiras_rl.interfaces import SkillEnv
from kiras_rl.limits import LARGEST, limited
from kiras_rl.models.estimator import VELOCITY_DIM, Estimator, mlp

KAPPA = 0.07  # of a turn, by which the schedule is smoothed

# --- the gait: Step and View are kiras_rl.envs' own -----------------------------------------------


def foot_turns(phase: torch.Tensor) -> torch.Tensor:
    """Return the turn of each foot of a trot, (N, 4), in [0, 1), for that of the clock, (N, 1)."""
    return torch.cat([(phase + offset) % 1.0 for offset in TROT], dim=1)


def desired_contact(turns: torch.Tensor) -> torch.Tensor:
    """Return C(theta) in [0, 1], how far each foot shall stand, for turns (N, F)."""
    normal = torch.special.ndtr
    begun = normal(turns / KAPPA) * (1.0 - normal((turns - 0.5) / KAPPA))
    again = normal((turns - 1.0) / KAPPA) * (1.0 - normal((turns - 1.5) / KAPPA))
    return begun + again


def swing_arc(turns: torch.Tensor) -> torch.Tensor:
    """Return how high a foot shall be, as a share of the swing height, for turns (N, F).

    psi = 1 - |1 - 2 clip(2 theta - 1, 0, 1)|: 0 in stance, 1 in the middle of a swing.
    """
    return 1.0 - (1.0 - 2.0 * (2.0 * turns - 1.0).clamp(0.0, 1.0)).abs()


def contact_force(step: Any, scale: float) -> torch.Tensor:
    """Return the mean over feet of (1 - C)(1 - exp(-F^2 / scale)), forces in body weights.

    Like all terms of the gait 0 for a robot that is told to stand.
    """
    force = (step.robot.foot_force / step.weight).square()
    swings = 1.0 - desired_contact(_turns(step))
    return (swings * (1.0 - torch.exp(-force / scale))).mean(dim=-1) * step.moves


def contact_velocity(step: Any, scale: float) -> torch.Tensor:
    """Return the mean over feet of C (1 - exp(-v^2 / scale)), velocities in m/s."""
    speed = step.robot.foot_vel_w.square().sum(dim=-1)
    stance = desired_contact(_turns(step))
    return (stance * (1.0 - torch.exp(-speed / scale))).mean(dim=-1) * step.moves


def swing_height(step: Any) -> torch.Tensor:
    """Return the sum over feet of (1 - C) (psi h - z)^2, m^2, h the commanded height of a swing."""
    turns = _turns(step)
    error = swing_arc(turns) * step.task.terms["swing_height"] - step.robot.foot_height
    swings = 1.0 - desired_contact(turns)
    return (swings * error.square()).sum(dim=-1) * step.moves


def body_height(step: Any) -> torch.Tensor:
    """Return the squared error of the base height from that of the skill, m^2."""
    return (step.robot.base_height - step.keyframes.height[step.task.skill]).square()


def body_orientation(step: Any) -> torch.Tensor:
    """Return the squared error of projected gravity, x and y, from that of the skill."""
    error = step.robot.gravity_b - step.keyframes.gravity_b[step.task.skill]
    return error[:, :2].square().sum(dim=-1)


@observed(onboard=trot_clock)
def clock_signal(view: Any) -> torch.Tensor:
    """Return sin(2 pi theta) of the turn of each foot, 4."""
    return torch.sin(2 * torch.pi * foot_turns(view.task.terms["clock"][:, :1]))


@observed(onboard=trot_behaviour)
def behaviour(view: Any) -> torch.Tensor:
    """Return the commanded step frequency and swing height, 2, Hz and m."""
    terms = view.task.terms
    return torch.cat([terms["clock"][:, 1:], terms["swing_height"]], dim=1)


def _turns(step: Any) -> torch.Tensor:
    return foot_turns(step.task.terms["clock"][:, :1])


# --- adaptation -----------------------------------------------------------------------------------


@dataclass
class WtwConfig:
    """Keys of the part.

    Attributes:
        properties: Terms of `env.observations.critic` that are estimated beside the velocity.
        encoder_dims: Widths.
        relative_step: Adam's step size, of the actor's.
        epochs: Passes over a rollout.
    """

    properties: list[str]
    encoder_dims: list[int] = field(metadata=limited(0, 100_000, above=True))
    relative_step: float = field(metadata=limited(0, LARGEST))
    epochs: int = field(metadata=limited(1, 1000))


class AdaptationModule(Estimator):
    """Network E(o_{t-H..t}) -> velocity, K properties; the actor reads both and the past frames."""

    def __init__(
        self, proprio_dim: int, history_length: int, properties: int, encoder_dims: list[int]
    ) -> None:
        """Build the network."""
        past = history_length * proprio_dim
        super().__init__(VELOCITY_DIM + properties + past)
        self._shape = {
            "proprio_dim": proprio_dim,
            "history_length": history_length,
            "properties": properties,
            "encoder_dims": list(encoder_dims),
        }
        self._past = past
        self.encoder = mlp(past + proprio_dim, encoder_dims, VELOCITY_DIM + properties)

    def frames(self, obs: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Return the past frames and the current one, oldest first, (N, (H + 1) * P)."""
        return torch.cat([obs[names.HISTORY], obs[names.PROPRIO]], dim=-1)

    def context(self, frames: torch.Tensor) -> torch.Tensor:
        """Return velocity, properties and past frames, (N, 3 + K + H * P)."""
        return torch.cat([self.encoder(frames), frames[..., : self._past]], dim=-1)


class Adaptation(Told):
    """The adaptation module and its trainer."""

    settings = WtwConfig
    estimator: AdaptationModule

    def __init__(
        self, config: WtwConfig, module: AdaptationModule, columns: list[int], device: str
    ) -> None:
        """Take the network, and the columns of the critic's observation that it estimates."""
        super().__init__(module, config.relative_step, config.epochs, device)
        self._columns = torch.tensor(columns, device=device)

    @classmethod
    def build(cls, config: WtwConfig, setting: Setting) -> Adaptation:
        """Build for the observations of an environment.

        Raises:
            ConfigError: A property that the critic does not observe.
        """
        proprio, history, critic = (
            setting.obs[key].shape[1] for key in (names.PROPRIO, names.HISTORY, names.CRITIC)
        )
        columns = find_columns(setting.env, config.properties, proprio, critic)
        module = AdaptationModule(proprio, history // proprio, len(columns), config.encoder_dims)
        return cls(config, module, columns, setting.device)

    def update(self, rollout: GroupRolloutStorage, iteration: Iteration) -> dict[str, float]:
        """Train on the rollout; return the errors for the log."""
        obs = rollout.observations
        properties = obs[names.CRITIC][..., self._columns]
        means = self.train(rollout, iteration, velocity=obs[names.VELOCITY], properties=properties)
        return {"Adaptation/velocity": means[0], "Adaptation/properties": means[1]}

    def _loss(
        self, frames: torch.Tensor, velocity: torch.Tensor, properties: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the loss on rows of the rollout and mean squared errors of both, (2,).

        Args:
            frames: (B, (H + 1) * P).
            velocity: Base velocity in the base frame, (B, 3), m/s.
            properties: In the scale of their observation, (B, K).
        """
        told = self.estimator.encoder(frames)
        error = (told[:, :VELOCITY_DIM] - velocity).square().mean()
        other = (told[:, VELOCITY_DIM:] - properties).square().mean()
        return VELOCITY_SCALE**2 * error + other, torch.stack([error, other])


def find_columns(env: SkillEnv, properties: list[str], proprio: int, critic: int) -> list[int]:
    """Return the columns of the critic's observation that hold some of its terms.

    Args:
        env: The environment.
        properties: Names of terms of `env.observations.critic`.
        proprio: P, with which the observation begins.
        critic: Its length.

    Raises:
        ConfigError: None named, or one that is not configured.
    """
    terms = [env.name_term(names.CRITIC, column) for column in range(proprio, critic)]
    if not properties:
        raise ConfigError("properties=[]: name at least one term of env.observations.critic")
    columns = []
    for name in properties:
        key = f"env.observations.critic.{name}"
        if key not in terms:
            raise ConfigError(f"properties: no {key} is configured, so it cannot be estimated")
        columns += [proprio + i for i, term in enumerate(terms) if term == key]
    return columns
