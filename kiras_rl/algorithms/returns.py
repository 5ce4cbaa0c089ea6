"""Advantages of several reward groups, and how they become one."""

from __future__ import annotations

import torch

from kiras_rl import distributed


def generalized_advantages(
    rewards: torch.Tensor,
    values: torch.Tensor,
    last_values: torch.Tensor,
    dones: torch.Tensor,
    gamma: float,
    lam: float,
) -> torch.Tensor:
    """Return GAE of each group on its own.

    Args:
        rewards: With time-outs already bootstrapped, (T, N, G).
        values: V(s_t), (T, N, G).
        last_values: V(s_T), (N, G).
        dones: Episodes that ended at t, (T, N, 1).
        gamma: Discount.
        lam: GAE's lambda.

    Returns:
        Advantages, (T, N, G).
    """
    going_on = 1.0 - dones.float()
    advantages = torch.zeros_like(rewards)
    advantage = torch.zeros_like(last_values)
    next_values = last_values
    for t in reversed(range(len(rewards))):
        # delta_t = r_t + gamma V(s_{t+1}) - V(s_t);  A_t = delta_t + gamma lambda A_{t+1}
        delta = rewards[t] + going_on[t] * gamma * next_values - values[t]
        advantage = delta + going_on[t] * gamma * lam * advantage
        advantages[t] = advantage
        next_values = values[t]
    return advantages


def mix_advantages(
    advantages: torch.Tensor, weights: tuple[float, ...], std_floor: float
) -> torch.Tensor:
    """Normalise each group over all ranks and add them with weights (omega_1, omega_2).

    The floor keeps a reward group that never varies from being blown up to unit noise.

    Args:
        advantages: (T, N, G).
        weights: One a group.
        std_floor: Least standard deviation that is divided by.

    Returns:
        (T, N, 1).
    """
    pool = distributed.gather(advantages, dim=1)
    mean = pool.mean(dim=(0, 1))
    std = pool.std(dim=(0, 1)).clamp(min=std_floor)
    omega = torch.tensor(weights, device=advantages.device)
    return ((advantages - mean) / std * omega).sum(dim=-1, keepdim=True)
