"""The residual reward of terrain finetuning: do not leave what skill learning found."""

from __future__ import annotations

import copy

import torch
from tensordict import TensorDict

from kiras_rl import interfaces as names
from kiras_rl.models.exported import ExportedPolicy


class Reference:
    """The policy of skill learning, frozen with its own estimator.

    r_res = -|a - a_flat|, the distance between the action that was taken and the one that the
    reference chooses for the same observation. Taken, with its noise: the distance of the mean
    action is the same whatever the noise was, and so teaches a policy gradient nothing about it. On
    flat ground, where the reference is right, it weighs more: there the policy is to remember,
    elsewhere to learn.
    """

    def __init__(self, policy: ExportedPolicy, weight: float, flat_weight: float) -> None:
        """Copy the policy.

        Args:
            policy: Estimator and actor; what becomes of them later does not matter.
            weight: Of the reward, a step.
            flat_weight: The same in worlds whose ground is flat.
        """
        self.policy = copy.deepcopy(policy).requires_grad_(False)
        self._weight, self._flat_weight = weight, flat_weight
        self._distance: list[torch.Tensor] = []

    @torch.no_grad()
    def reward(
        self,
        obs: TensorDict,
        action: torch.Tensor,
        mean_action: torch.Tensor,
        is_flat: torch.Tensor,
    ) -> torch.Tensor:
        """Return the weighted reward of a step, (N,).

        Args:
            obs: What the actor saw.
            action: What was done, (N, J).
            mean_action: The same without noise, for the log, (N, J).
            is_flat: Worlds whose ground is flat, (N,) bool.
        """
        flat, _ = self.policy(obs[names.PROPRIO], obs[names.HISTORY])
        self._distance.append(torch.linalg.vector_norm(mean_action - flat, dim=-1).mean())
        distance = torch.linalg.vector_norm(action - flat, dim=-1)
        return -torch.where(is_flat, self._flat_weight, self._weight) * distance

    def mean_distance(self) -> float:
        """Return the mean distance of the actions without noise since the last call."""
        mean = torch.stack(self._distance).mean().item()
        self._distance.clear()
        return mean

    def state_dict(self) -> dict:
        """Return the frozen weights."""
        return self.policy.state_dict()

    def load_state_dict(self, state: dict) -> None:
        """Take the frozen weights of a saved state."""
        self.policy.load_state_dict(state)
