"""The discriminator of self-imitation and the reward it gives."""

from __future__ import annotations

import torch
from torch import nn

from kiras_rl.models.precision import apply_layers


class Discriminator(nn.Module):
    """D(Phi_{t-1}, Phi_t): +1 for expert pairs, -1 for the policy's."""

    def __init__(self, feature_dim: int, hidden_dims: list[int], bfloat16: bool) -> None:
        """Build an MLP from 2 * feature_dim to 1 with ReLU.

        Args:
            feature_dim: D.
            hidden_dims: Widths.
            bfloat16: Multiply the hidden layers in it.
        """
        super().__init__()
        self._bfloat16 = bfloat16
        layers: list[nn.Module] = []
        width = 2 * feature_dim
        for hidden in hidden_dims:
            layers += [nn.Linear(width, hidden), nn.ReLU()]
            width = hidden
        self.net = nn.Sequential(*layers, nn.Linear(width, 1))

    def forward(self, pairs: torch.Tensor) -> torch.Tensor:
        """Return scores of pairs (N, 2 D), (N,)."""
        return apply_layers(self.net, pairs, self._bfloat16).squeeze(-1)


def imitation_reward(score: torch.Tensor) -> torch.Tensor:
    """Return max(1 - (D - 1)^2 / 4, 0): the paper's SIL reward, in [0, 1]."""
    return (1.0 - 0.25 * (score - 1.0).square()).clamp(min=0.0)
