"""Adam as every part of the learner takes it: one kernel a step, and fit for a CUDA graph."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import nn


def make_adam(
    parameters: Iterable[nn.Parameter], lr: float | torch.Tensor, device: str
) -> torch.optim.Adam:
    """Return the optimizer; a step size that changes is a tensor on the device."""
    return torch.optim.Adam(parameters, lr=lr, fused=True, capturable=_on_gpu(device))


def load_adam(optimizer: torch.optim.Adam, state: dict, device: str) -> None:
    """Go on from a state that was saved on any device."""
    rates = [group["lr"] for group in optimizer.param_groups]
    optimizer.load_state_dict(state)
    fit_adam(optimizer, rates, device)


def fit_adam(optimizer: torch.optim.Adam, rates: list[float | torch.Tensor], device: str) -> None:
    """Give a loaded optimizer its own step sizes and the options of this device."""
    for group, rate in zip(optimizer.param_groups, rates, strict=True):
        group["lr"], group["capturable"] = rate, _on_gpu(device)


def _on_gpu(device: str) -> bool:
    return torch.device(device).type == "cuda"
