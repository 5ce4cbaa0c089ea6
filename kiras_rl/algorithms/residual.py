"""What holds terrain finetuning near what skill learning found."""

from __future__ import annotations

import copy

import torch
from tensordict import TensorDict

from kiras_rl import interfaces as names
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
    def record(self, obs: TensorDict, action: torch.Tensor, is_flat: torch.Tensor) -> torch.Tensor:
        """Write what the loss needs into `obs`; return the residual reward of a step, (N,).

        Args:
            obs: What the actor saw.
            action: What was done, (N, J).
            is_flat: Worlds whose ground is flat, (N,) bool.
        """
        flat, _ = self.policy(obs[names.PROPRIO], obs[names.HISTORY])
        obs[names.FLAT_ACTION], obs[names.IS_FLAT] = flat, is_flat.unsqueeze(1)
        return -self._reward_weight * torch.linalg.vector_norm(action - flat, dim=-1)

    def state_dict(self) -> dict:
        """Return the frozen weights."""
        return self.policy.state_dict()

    def load_state_dict(self, state: dict) -> None:
        """Take the frozen weights of a saved state."""
        self.policy.load_state_dict(state)
