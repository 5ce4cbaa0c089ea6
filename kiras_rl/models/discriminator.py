"""The discriminator of self-imitation and the reward it gives."""

from __future__ import annotations

import torch
from torch import nn

from kiras_rl.config import ConfigError

PRECISIONS = ("auto", "float32", "bfloat16")


class Discriminator(nn.Module):
    """D(Phi_{t-1}, Phi_t): +1 for expert pairs, -1 for the policy's."""

    def __init__(self, feature_dim: int, hidden_dims: list[int], bfloat16: bool = False) -> None:
        """Build an MLP from 2 * feature_dim to 1 with ReLU.

        Args:
            feature_dim: D.
            hidden_dims: Widths.
            bfloat16: Multiply the hidden layers in it; weights and scores stay float32.
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
        with torch.autocast(pairs.device.type, torch.bfloat16, enabled=self._bfloat16):
            hidden = self.net[:-1](pairs)
        return self.net[-1](hidden.float()).squeeze(-1)


def imitation_reward(score: torch.Tensor) -> torch.Tensor:
    """Return max(1 - (D - 1)^2 / 4, 0): the paper's SIL reward, in [0, 1]."""
    return (1.0 - 0.25 * (score - 1.0).square()).clamp(min=0.0)


def uses_bfloat16(precision: str, device: torch.device | str) -> bool:
    """Return whether the hidden layers are multiplied in bfloat16.

    Args:
        precision: One of PRECISIONS. auto is bfloat16 on a CPU that multiplies it natively, which
            takes half of the time; on a GPU these networks are bound by launches.
        device: Of the discriminator.

    Raises:
        ConfigError: Unknown precision.
    """
    if precision not in PRECISIONS:
        raise ConfigError(
            f"learner.imitation.discriminator.precision={precision}: allowed are "
            f"{', '.join(PRECISIONS)}"
        )
    if precision != "auto":
        return precision == "bfloat16"
    is_native = getattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)
    return torch.device(device).type == "cpu" and is_native()
