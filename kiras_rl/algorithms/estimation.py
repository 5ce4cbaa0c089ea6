"""Context estimation: what the actor is told about velocity and terrain, and how it is learned."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch
from tensordict import TensorDict
from torch import nn

from kiras_rl import interfaces as names
from kiras_rl.algorithms import losses
from kiras_rl.algorithms.adaboot import MODES, AdaBoot
from kiras_rl.algorithms.part import Iteration, Outcome, Part, Setting
from kiras_rl.algorithms.storage import GroupRolloutStorage, mini_batches
from kiras_rl.algorithms.trainer import Trainer
from kiras_rl.config import ConfigError
from kiras_rl.models.estimator import (
    VELOCITY_DIM,
    ContextEstimator,
    Estimator,
    VariationalEstimator,
)
from kiras_rl.schema import EstimatorConfig
from kiras_rl.shards import Batch

VELOCITY_SCALE = 2.0  # in the loss: velocity errors then weigh as much as observation errors


class Told(Part):
    """An estimator and its trainer: the actor is told the context. A subclass has the loss."""

    estimator: Estimator

    def __init__(
        self, estimator: Estimator, relative_step: float, epochs: int, device: str
    ) -> None:
        """Take the network.

        Args:
            estimator: The network.
            relative_step: Adam's step size, of the actor's.
            epochs: Passes over a rollout.
            device: Of the network.
        """
        self.estimator = estimator.to(device)
        self._relative_step, self._epochs = relative_step, epochs
        self._data: dict[str, torch.Tensor] = {}
        self._num_mini_batches = 1
        self.trainer = Trainer(
            self.estimator.parameters(),
            self._loss,
            0.0,  # set anew before every update
            device,
            self._batches,
            variant=lambda: self._num_mini_batches,
        )

    def groups(self, obs: TensorDict) -> dict[str, torch.Tensor]:
        """Return the context."""
        return self.observe(obs)

    def observe(self, obs: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Return the context: an observation of the step as all others are."""
        return {names.CONTEXT: self.context(obs)}

    @torch.no_grad()
    def context(self, obs: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Return what the actor is told, (N, context_dim)."""
        return self.estimator.context(self.estimator.frames(obs))

    def train(
        self, rollout: GroupRolloutStorage, iteration: Iteration, **data: torch.Tensor
    ) -> list[float]:
        """Train on frames and other data of a rollout; return the means of what the loss reports.

        A step changes what the actor is told, and so its actions, past PPO's trust region. Its size
        follows that of the actor's, which must be able to follow.
        """
        torch.mul(iteration.actor_rate, self._relative_step, out=self.trainer.rate)
        frames = self.estimator.frames(rollout.observations)
        rollout.shuffle_into(self._data, frames=frames, **data)
        self._num_mini_batches = iteration.mini_batches
        return self.trainer.train(self._epochs).tolist()

    def _batches(self) -> Iterator[Batch]:
        return iter(mini_batches(self._data, self._num_mini_batches))

    def _loss(self, **batch: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the loss of a batch, and what is reported of it."""
        raise NotImplementedError

    def networks(self) -> dict[str, nn.Module]:
        """Return the estimator."""
        return {"estimator": self.estimator}

    def lasting(self) -> dict[str, nn.Module]:
        """Return the estimator."""
        return self.networks()

    def onboard(self) -> Estimator:
        """Return the estimator."""
        return self.estimator

    def state_dict(self) -> dict:
        """Return network and optimizer."""
        return {"estimator": self.estimator.state_dict(), "optimizer": self.trainer.state_dict()}

    def load_state_dict(self, state: dict) -> None:
        """Go on from a saved state."""
        self.estimator.load_state_dict(state["estimator"])
        self.trainer.load_state_dict(state["optimizer"])


class Estimation(Told):
    """A variational estimator, its trainer and AdaBoot."""

    estimator: VariationalEstimator

    def __init__(
        self,
        config: EstimatorConfig,
        estimator: VariationalEstimator,
        num_envs: int,
        device: str,
    ) -> None:
        """Take the network.

        Raises:
            ConfigError: Unknown AdaBoot mode.
        """
        if config.adaboot not in MODES:
            raise ConfigError(
                f"learner.estimator.adaboot={config.adaboot}: allowed are {', '.join(MODES)}"
            )
        super().__init__(estimator, config.relative_step, config.epochs, device)
        self.config, self._device = config, device
        self.adaboot = AdaBoot(config.adaboot, config.adaboot_floor, num_envs, device)

    @classmethod
    def build(cls, config: EstimatorConfig, setting: Setting) -> Estimation:
        """Build for the observations of an environment.

        Raises:
            ConfigError: Unknown AdaBoot mode.
        """
        obs = setting.obs
        proprio = obs[names.PROPRIO].shape[1]
        estimator = ContextEstimator(
            proprio_dim=proprio,
            history_length=obs[names.HISTORY].shape[1] // proprio,
            num_skills=len(setting.env.skills),
            latent_dim=config.latent_dim,
            encoder_dims=list(config.encoder_dims),
            decoder_dims=list(config.decoder_dims),
        )
        return cls(config, estimator, len(obs), setting.device)

    def groups(self, obs: TensorDict) -> dict[str, torch.Tensor]:
        """Return the context, and the frame that is to be predicted."""
        return super().groups(obs) | {names.NEXT_PROPRIO: torch.zeros_like(obs[names.PROPRIO])}

    @torch.no_grad()
    def context(self, obs: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Return the actor's context, (N, 3 + Z).

        With AdaBoot on the input, worlds that do not trust the estimate are told the true velocity.
        """
        context = super().context(obs)
        if self.adaboot.bootstraps_input:
            told = self.adaboot.uses_estimate[:, None]
            velocity = torch.where(told, context[:, :VELOCITY_DIM], obs[names.VELOCITY])
            context = torch.cat([velocity, context[:, VELOCITY_DIM:]], dim=-1)
        return context

    def record(self, rollout: GroupRolloutStorage, step: Outcome) -> dict[str, torch.Tensor]:
        """Let AdaBoot see rewards and dones; store the frame after the step."""
        self.adaboot.record(step.rewards, step.dones)
        return {names.NEXT_PROPRIO: step.extras[names.NEXT_PROPRIO]}

    def update(self, rollout: GroupRolloutStorage, iteration: Iteration) -> dict[str, float]:
        """Train on the rollout unless AdaBoot withholds it; return scalars for the log."""
        self.adaboot.renew()
        trained = self.adaboot.update_allowed()
        scalars = {
            "AdaBoot/trust": self.adaboot.probability.item(),
            "AdaBoot/trained": float(trained),
        }
        if trained:
            scalars |= self._train(rollout, iteration)
        return scalars

    def _train(self, rollout: GroupRolloutStorage, iteration: Iteration) -> dict[str, float]:
        obs = rollout.observations
        means = self.train(
            rollout,
            iteration,
            velocity=obs[names.VELOCITY],
            target=obs[names.NEXT_PROPRIO],
            skill=obs[names.SKILL],
            goes_on=rollout.dones == 0,
        )
        tags = ("velocity", "prediction", "kl", "prior")
        return {f"Estimator/{tag}": value for tag, value in zip(tags, means, strict=True)}

    def _batches(self) -> Iterator[Batch]:
        for batch in mini_batches(self._data, self._num_mini_batches):
            noise = torch.randn(len(batch["skill"]), self.config.latent_dim, device=self._device)
            goes_on = batch.pop("goes_on").squeeze(-1)  # an end has no next frame
            yield batch | {"noise": noise, "target_weight": losses.weights_of(goes_on)}

    def _loss(self, **batch: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        parts = self._losses(**batch)
        velocity, prediction, kl, prior = parts
        loss = velocity * VELOCITY_SCALE**2 + prediction
        loss = loss + self.config.kl_weight * kl + self.config.prior_weight * prior
        return loss, torch.stack(parts)

    def _losses(
        self,
        frames: torch.Tensor,
        velocity: torch.Tensor,
        target: torch.Tensor,
        skill: torch.Tensor,
        noise: torch.Tensor,
        target_weight: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return errors of velocity ((m/s)^2) and prediction, KL to the prior, KL of the prior."""
        estimate, mean, log_var = self.estimator(frames)
        latent = mean + noise * torch.exp(0.5 * log_var)
        prediction = self.estimator.decode(estimate, latent, skill)
        prior_mean, prior_log_var = self.estimator.prior_of(skill)
        zero = torch.zeros_like(prior_mean)
        return (
            (estimate - velocity).square().mean(),
            losses.weighted_mse(prediction, target, target_weight),
            losses.gaussian_kl(mean, log_var, prior_mean, prior_log_var).mean(),
            losses.gaussian_kl(prior_mean, prior_log_var, zero, zero).mean(),
        )

    def state_dict(self) -> dict:
        """Return network, optimizer and AdaBoot."""
        return super().state_dict() | {"adaboot": self.adaboot.state_dict()}

    def load_state_dict(self, state: dict) -> None:
        """Go on from a saved state."""
        super().load_state_dict(state)
        self.adaboot.load_state_dict(state["adaboot"])

    def world_state(self) -> dict:
        """Return AdaBoot's episodes."""
        return self.adaboot.world_state()

    def load_world_state(self, state: dict) -> None:
        """Take AdaBoot's episodes."""
        self.adaboot.load_state_dict(state)
