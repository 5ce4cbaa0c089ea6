"""What holds terrain finetuning near what skill learning found."""

from __future__ import annotations

import copy
from collections.abc import Mapping

import torch

from kiras_rl import interfaces as names
from kiras_rl.algorithms.storage import GroupRolloutStorage
from kiras_rl.models.exported import ExportedPolicy
from kiras_rl.schema import RetentionConfig


class Reference:
    """The policy of skill learning, frozen with its own estimator.

    It holds the policy in two ways. Everywhere by the paper's residual reward, r_res =
    -|a - a_flat|, of the action that was taken: the distance of mean actions does not depend on
    the noise, so a policy gradient could not follow it. And on flat ground, where the reference is
    right, by a loss on the mean action, whose gradient is exact: within a few thousand iterations
    the reward alone is lost among the noise of the returns, and postures sink.
    """

    def __init__(
        self, policy: ExportedPolicy, config: RetentionConfig, reward_scale: float
    ) -> None:
        """Copy the policy.

        Args:
            policy: Estimator and actor; what becomes of them later does not matter.
            config: Weights of reward and loss.
            reward_scale: Factor of the reward's weight, as all rewards of a step have it.
        """
        self.policy = copy.deepcopy(policy).requires_grad_(False)
        self.loss_weight = config.flat_loss_weight
        self._reward_weight = config.residual_weight * reward_scale

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

    def describe(self, storage: GroupRolloutStorage) -> dict[str, float]:
        """Return how far the mean actions of a rollout are from those of the flat policy."""
        flat, is_flat = (storage.observations[key] for key in (names.FLAT_ACTION, names.IS_FLAT))
        distance = torch.linalg.vector_norm(storage.action_mean - flat, dim=-1)
        weight = is_flat.squeeze(-1).float()
        on_flat = (distance * weight).sum() / weight.sum().clamp(min=1.0)
        return {
            "Residual/distance": distance.mean().item(),
            "Residual/flat_distance": on_flat.item(),
        }

    def state_dict(self) -> dict:
        """Return the frozen weights."""
        return self.policy.state_dict()

    def load_state_dict(self, state: dict) -> None:
        """Take the frozen weights of a saved state."""
        self.policy.load_state_dict(state)
