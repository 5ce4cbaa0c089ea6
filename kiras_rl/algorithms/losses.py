"""Losses and the learning-rate rule as free functions."""

from __future__ import annotations

import torch
from torch import nn

from kiras_rl import distributed


def surrogate_loss(
    log_prob: torch.Tensor, old_log_prob: torch.Tensor, advantage: torch.Tensor, clip: float
) -> torch.Tensor:
    """Return the clipped PPO objective, negated; all arguments (B,)."""
    ratio = torch.exp(log_prob - old_log_prob)
    clipped = ratio.clamp(1.0 - clip, 1.0 + clip)
    return torch.max(-advantage * ratio, -advantage * clipped).mean()


def value_loss(values: torch.Tensor, returns: torch.Tensor) -> torch.Tensor:
    """Return the squared error summed over groups and averaged over the batch, (B, G).

    Values are not clipped around the old ones: the clip range is a number of the ratio's scale and
    would slow critics whose returns reach 100.
    """
    return (values - returns).square().mean(dim=0).sum()


def weights_of(mask: torch.Tensor) -> torch.Tensor:
    """Return weights, (B,), with which a mean over the batch is one over the rows of a mask, (B,).

    Over those of all ranks: they differ in how many rows count, and the mean of their gradients has
    to be the gradient of the mean over all. Zero where no row of any rank counts.
    """
    weight = mask.float()
    counted = distributed.mean(weight.sum()).clamp(min=1.0 / distributed.size())
    return weight * (len(weight) / counted)


def retention_loss(
    mean: torch.Tensor, flat_action: torch.Tensor, weight: torch.Tensor
) -> torch.Tensor:
    """Return E |mu - a_flat|^2 over the steps on flat ground; 0 where there are none.

    Args:
        mean: Mean actions, (B, J).
        flat_action: Actions of the frozen flat policy, (B, J).
        weight: `weights_of` the steps on flat ground, (B,).
    """
    return ((mean - flat_action).square().sum(-1) * weight).mean()


def adapt_learning_rate(
    rate: torch.Tensor, kl: torch.Tensor, desired_kl: torch.Tensor, limits: tuple[float, float]
) -> torch.Tensor:
    """Return a lower rate where the policy moved too far, a higher one where it hardly moved.

    Args:
        rate: Step size, a number on the device.
        kl: Divergence of the policy from that of the rollout, a number on the device.
        desired_kl: What it should be.
        limits: Of the step size.
    """
    slower, faster = (rate / 1.5).clamp(min=limits[0]), (rate * 1.5).clamp(max=limits[1])
    hardly = (kl > 0.0) & (kl < desired_kl / 2.0)
    return torch.where(kl > 2.0 * desired_kl, slower, torch.where(hardly, faster, rate))


def discriminator_loss(
    expert: torch.Tensor, policy: torch.Tensor, weight: torch.Tensor
) -> torch.Tensor:
    """Return the LSGAN loss E[(D - 1)^2] on experts + E[(D + 1)^2] on the policy.

    Args:
        expert: Scores of expert pairs, (B,).
        policy: Scores of the policy's pairs, (B,).
        weight: `weights_of` those of the policy's pairs that count, (B,).
    """
    return ((expert - 1.0).square() + weight * (policy + 1.0).square()).mean()


def gradient_penalty(
    discriminator: nn.Module, points: torch.Tensor, features: torch.Tensor
) -> torch.Tensor:
    """Return E |dD/dx|^2.

    On points between expert and policy it makes D change steadily from the one to the other, so
    that a motion far from its keyframe still learns in which direction the keyframe lies.

    Args:
        discriminator: (B, 2 D) -> (B,).
        points: Pairs, (B, 2 D).
        features: Inputs that count, (2 D,) bool; the code of the skill does not.
    """
    points = points.detach().requires_grad_()
    scores = discriminator(points)
    (gradient,) = torch.autograd.grad(scores.sum(), points, create_graph=True)
    return (gradient * features).square().sum(-1).mean()


def gaussian_kl(
    mean: torch.Tensor, log_var: torch.Tensor, prior_mean: torch.Tensor, prior_log_var: torch.Tensor
) -> torch.Tensor:
    """Return KL(q || p) of diagonal Gaussians, summed over the last dimension, (N,)."""
    var_ratio = torch.exp(log_var - prior_log_var)
    shift = (mean - prior_mean).square() / torch.exp(prior_log_var)
    return 0.5 * (prior_log_var - log_var + var_ratio + shift - 1.0).sum(-1)


def weighted_mse(
    prediction: torch.Tensor, target: torch.Tensor, weight: torch.Tensor
) -> torch.Tensor:
    """Return the mean squared error of rows (N, k), each with its weight (N,)."""
    return ((prediction - target).square() * weight.unsqueeze(-1)).mean()
