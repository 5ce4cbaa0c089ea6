"""Hidden layers in bfloat16, where a CPU multiplies that in half of the time."""

from __future__ import annotations

import torch
from torch import nn

from kiras_rl.config import ConfigError

PRECISIONS = ("auto", "float32", "bfloat16")


def uses_bfloat16(precision: str, device: torch.device | str) -> bool:
    """Return whether hidden layers are multiplied in bfloat16.

    Args:
        precision: One of PRECISIONS. auto is bfloat16 on a CPU that multiplies it natively; on a
            GPU these networks are bound by launches.
        device: Of the networks.

    Raises:
        ConfigError: Unknown precision.
    """
    if precision not in PRECISIONS:
        raise ConfigError(f"learner.precision={precision}: allowed are {', '.join(PRECISIONS)}")
    if precision != "auto":
        return precision == "bfloat16"
    is_native = getattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)
    return torch.device(device).type == "cpu" and is_native()


def apply_layers(layers: nn.Sequential, x: torch.Tensor, bfloat16: bool) -> torch.Tensor:
    """Return what a network makes of x, float32.

    The output layer is float32 in any case: it sums over many hidden units, whose rounding evens
    out, while that of an output would stay. Weights and gradients are float32, too.

    Args:
        layers: Linear layers and activations; the last one is the output.
        x: Inputs, (..., features), float32.
        bfloat16: Multiply the hidden layers in it.
    """
    *hidden, output = layers
    # Without its cache of rounded weights, which threads would share: each is used once anyway
    with torch.autocast(x.device.type, torch.bfloat16, enabled=bfloat16, cache_enabled=False):
        for layer in hidden:
            x = layer(x)
    return output(x.float())
