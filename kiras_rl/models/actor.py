"""The policy as it is trained: a network, and the scatter of the actions around its outputs."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import GaussianDistribution
from tensordict import TensorDict
from torch import nn


class Actor(MLPModel):
    """Gaussian actions whose standard deviation is set from outside, not learned."""

    distribution: GaussianDistribution

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        num_actions: int,
        hidden_dims: list[int],
        std: float,
    ) -> None:
        """Build the network on the observation set "actor"; its first outputs are near zero.

        Args:
            obs: An observation of the environment.
            obs_groups: Which of its entries make a set.
            num_actions: J.
            hidden_dims: Widths.
            std: Standard deviation at first.
        """
        scatter = {"class_name": "GaussianDistribution", "init_std": std, "learn_std": False}
        super().__init__(
            obs, obs_groups, "actor", num_actions, hidden_dims, "elu", distribution_cfg=scatter
        )
        start_near_zero(self.mlp)

    def get_latent(self, obs: Mapping[str, torch.Tensor], *_: object) -> torch.Tensor:
        """Return what the network reads of an observation, (N, ...)."""
        return torch.cat([obs[group] for group in self.obs_groups], dim=-1)


def start_near_zero(network: nn.Module) -> None:
    """Make the outputs small: the robot begins in its default pose, not in a random one."""
    *_, weight, bias = network.parameters()
    nn.init.normal_(weight, std=0.01)
    nn.init.zeros_(bias)
