"""One critic a reward group behind the interface of one critic."""

from __future__ import annotations

import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import nn

from kiras_rl.models.precision import apply_layers


class GroupCritic(nn.Module):
    """G independent value networks; group 0 is the task, group 1 imitation."""

    is_recurrent = False

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        num_groups: int,
        hidden_dims: list[int],
        bfloat16: bool,
    ) -> None:
        """Build G networks on the observation set "critic".

        Args:
            obs: An observation of the environment.
            obs_groups: Which of its entries make a set.
            num_groups: G.
            hidden_dims: Widths.
            bfloat16: Multiply the hidden layers in it.
        """
        super().__init__()
        self.critics = nn.ModuleList(
            _Critic(obs, obs_groups, hidden_dims, bfloat16) for _ in range(num_groups)
        )

    def forward(self, obs: TensorDict, **_: object) -> torch.Tensor:
        """Return the values of every group, (N, G)."""
        return torch.cat([critic(obs) for critic in self.critics], dim=-1)

    def reset(self, dones: torch.Tensor | None = None, hidden_state: object = None) -> None:
        """Do nothing: there is no memory."""

    def get_hidden_state(self) -> None:
        """Return None: there is no memory."""
        return None

    def update_normalization(self, obs: TensorDict) -> None:
        """Do nothing: observations have fixed scales."""


class _Critic(MLPModel):
    """The value network of one group."""

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        hidden_dims: list[int],
        bfloat16: bool,
    ) -> None:
        super().__init__(obs, obs_groups, "critic", 1, hidden_dims, "elu")
        self._bfloat16 = bfloat16

    def forward(self, obs: TensorDict, *_: object) -> torch.Tensor:
        return apply_layers(self.mlp, self.get_latent(obs), self._bfloat16)
