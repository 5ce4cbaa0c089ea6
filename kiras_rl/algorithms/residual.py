"""The residual reward of terrain finetuning: do not leave what skill learning found."""

from __future__ import annotations

import copy

import torch
from tensordict import TensorDict

from kiras_rl import interfaces as names
from kiras_rl.models.exported import ExportedPolicy


class Reference:
    """The policy of skill learning, frozen with its own estimator.

    r_res = -|mu - mu_flat|, the distance between the mean actions that policy and reference choose
    for the same observation. Means, because the distance of sampled actions would mostly measure
    the action noise. On flat ground, where the reference is right, it weighs more: there the
    policy is to remember, elsewhere to learn.
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
        self, obs: TensorDict, mean_action: torch.Tensor, is_flat: torch.Tensor
    ) -> torch.Tensor:
        """Return the weighted reward of a step, (N,).

        Args:
            obs: What the actor saw.
            mean_action: What it chose, without noise, (N, J).
            is_flat: Worlds whose ground is flat, (N,) bool.
        """
        flat, _ = self.policy(obs[names.PROPRIO], obs[names.HISTORY])
        distance = torch.linalg.vector_norm(mean_action - flat, dim=-1)
        self._distance.append(distance.mean())
        return -torch.where(is_flat, self._flat_weight, self._weight) * distance

    def mean_distance(self) -> float:
        """Return the mean distance since the last call."""
        mean = torch.stack(self._distance).mean().item()
        self._distance.clear()
        return mean

    def state_dict(self) -> dict:
        """Return the frozen weights."""
        return self.policy.state_dict()

    def load_state_dict(self, state: dict) -> None:
        """Take the frozen weights of a saved state."""
        self.policy.load_state_dict(state)
