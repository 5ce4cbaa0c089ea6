"""What holds terrain finetuning near what skill learning found."""

from __future__ import annotations

import copy
from collections.abc import Mapping

import torch
from tensordict import TensorDict
from torch import nn

from kiras_rl import interfaces as names
from kiras_rl.algorithms import losses
from kiras_rl.algorithms.part import Outcome, Part, Setting
from kiras_rl.algorithms.storage import GroupRolloutStorage
from kiras_rl.models.exported import ExportedPolicy
from kiras_rl.schema import RetentionConfig
from kiras_rl.shards import Batch

FLAT_WEIGHT = "flat_weight"
"""Of each row of a mini-batch in the loss, 0 on rough ground, (B,)."""


class Reference(Part):
    """The policy of skill learning, frozen with its own estimator.

    It holds the policy in two ways. Everywhere by the paper's residual reward, r_res =
    -|a - a_flat|, of the action that was taken: the distance of mean actions does not depend on
    the noise, so a policy gradient could not follow it. And on flat ground, where the reference is
    right, by a loss on the mean action, whose gradient is exact: within a few thousand iterations
    the reward alone is lost among the noise of the returns, and postures sink.
    """

    learns_from = (names.FLAT_ACTION, names.IS_FLAT)

    def __init__(self, config: RetentionConfig, num_actions: int, reward_scale: float) -> None:
        """Take the weights; the policy comes with `meet`.

        Args:
            config: Weights of reward and loss.
            num_actions: J.
            reward_scale: Factor of the reward's weight, as all rewards of a step have it.
        """
        self._num_actions = num_actions
        self._loss_weight = config.flat_loss_weight
        self._reward_weight = config.residual_weight * reward_scale

    @classmethod
    def build(cls, config: RetentionConfig, setting: Setting) -> Reference:
        """Build for a learner."""
        return cls(config, setting.env.num_actions, setting.reward_scale)

    def meet(self, policy: ExportedPolicy) -> None:
        """Copy estimator and actor; what becomes of them later does not matter."""
        self._trained = policy
        self.policy = copy.deepcopy(policy).requires_grad_(False)

    def groups(self, obs: TensorDict) -> dict[str, torch.Tensor]:
        """Return what the flat policy does, and where the ground is flat."""
        one = obs[names.PROPRIO][:, :1]
        return {
            names.FLAT_ACTION: one.new_zeros(len(one), self._num_actions),
            names.IS_FLAT: torch.zeros_like(one, dtype=torch.bool),
        }

    def record(self, rollout: GroupRolloutStorage, step: Outcome) -> dict[str, torch.Tensor]:
        """Add the residual reward; store what the flat policy would have done."""
        flat_action, residual = self.judge(step.seen, step.actions)
        step.rewards = step.rewards + residual
        return {names.FLAT_ACTION: flat_action, names.IS_FLAT: step.extras[names.EXTRA_FLAT]}

    @torch.no_grad()
    def judge(
        self, obs: Mapping[str, torch.Tensor], action: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return what the flat policy would have done, (N, J), and the residual reward, (N,).

        Args:
            obs: What the actor saw.
            action: What was done, (N, J).
        """
        flat, _ = self.policy(obs[names.PROPRIO], obs[names.HISTORY])
        return flat, -self._reward_weight * torch.linalg.vector_norm(action - flat, dim=-1)

    def prepare(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Return the weights of the rows, which flat ground shares."""
        return {FLAT_WEIGHT: losses.weights_of(batch[names.IS_FLAT].squeeze(1))}

    def policy_loss(self, mean: torch.Tensor, batch: Batch) -> torch.Tensor:
        """Return the weighted distance from the flat policy on flat ground."""
        return self._loss_weight * losses.retention_loss(
            mean, batch[names.FLAT_ACTION], batch[FLAT_WEIGHT]
        )

    def describe(self, rollout: GroupRolloutStorage) -> dict[str, float]:
        """Return how far the mean actions of a rollout are from those of the flat policy."""
        flat, is_flat = (rollout.observations[key] for key in self.learns_from)
        distance = torch.linalg.vector_norm(rollout.action_mean - flat, dim=-1)
        weight = is_flat.squeeze(-1).float()
        on_flat = (distance * weight).sum() / weight.sum().clamp(min=1.0)
        return {
            "Residual/distance": distance.mean().item(),
            "Residual/flat_distance": on_flat.item(),
        }

    def networks(self) -> dict[str, nn.Module]:
        """Return the frozen policy."""
        return {"reference": self.policy}

    def begin_from(self, networks: dict[str, dict], state: dict) -> None:
        """Freeze the policy as the phase before left it."""
        self.policy.load_state_dict(self._trained.state_dict())

    def state_dict(self) -> dict:
        """Return the frozen weights."""
        return self.policy.state_dict()

    def load_state_dict(self, state: dict) -> None:
        """Take the frozen weights of a saved state."""
        self.policy.load_state_dict(state)
