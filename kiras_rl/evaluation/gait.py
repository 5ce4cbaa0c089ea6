"""How feet step: how often, how high, and for how long they stand.

Letters: T steps, N robots, F feet.
"""

from __future__ import annotations

import torch


def lifts_per_second(stands: torch.Tensor, counted: torch.Tensor, step_dt: float) -> torch.Tensor:
    """Return how often each foot leaves the ground before the robot falls, (N, F), 1/s.

    Args:
        stands: Feet on the ground, (T, N, F) bool.
        counted: Steps that count, all before the fall, (T, N) bool.
        step_dt: s.
    """
    lifted = stands[:-1] & ~stands[1:] & (counted[:-1] & counted[1:])[:, :, None]
    return lifted.sum(dim=0) / (counted.sum(dim=0).clamp(min=1)[:, None] * step_dt)


def clearance(
    stands: torch.Tensor, height: torch.Tensor, counted: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the sum of the largest heights of each robot's whole swings, and their number.

    A swing is whole if the foot lifted and landed within the steps that count.

    Args:
        stands: Feet on the ground, (T, N, F) bool.
        height: Of their lowest points above the ground, (T, N, F), m.
        counted: Steps that count, (T, N) bool.

    Returns:
        Sums, (N,), m, and numbers, (N,).
    """
    peak = torch.full_like(height[0], torch.nan)  # of the swing at hand, NaN without one
    total, number = torch.zeros_like(peak), torch.zeros_like(peak)
    steps = zip(stands[:-1], stands[1:], height[1:], counted[1:], strict=True)
    for before, now, up, counts in steps:
        peak = torch.where(now, peak, torch.where(before, up, torch.maximum(peak, up)))
        landed = now & peak.isfinite() & counts[:, None]
        total, number = total + torch.where(landed, peak, 0.0), number + landed
        peak = torch.where(now | ~counts[:, None], torch.nan, peak)
    return total.sum(dim=1), number.sum(dim=1)
