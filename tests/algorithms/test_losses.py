"""Losses against hand arithmetic and torch.distributions."""

from __future__ import annotations

import math

import pytest
import torch
from torch.distributions import Normal, kl_divergence

from kiras_rl.algorithms.losses import (
    adapt_learning_rate,
    discriminator_loss,
    gaussian_kl,
    gradient_penalty,
    surrogate_loss,
    value_loss,
    weighted_mse,
    weights_of,
)


@pytest.mark.parametrize(
    ("ratio", "advantage", "expected"),
    [
        (1.0, 3.0, -3.0),
        (1.1, 3.0, -3.3),
        (1.5, 3.0, -3.6),  # no reward for moving further than the clip
        (0.5, 3.0, -1.5),
        (1.5, -2.0, 3.0),
        (0.5, -2.0, 1.6),  # nor for moving further away
    ],
)
def test_the_surrogate_is_clipped_only_where_that_is_pessimistic(ratio, advantage, expected):
    loss = surrogate_loss(
        torch.tensor([math.log(ratio)]), torch.zeros(1), torch.tensor([advantage]), clip=0.2
    )
    assert loss.item() == pytest.approx(expected)


def test_value_errors_are_averaged_over_the_batch_and_summed_over_groups():
    values, returns = torch.tensor([[1.0, 0.0], [3.0, 2.0]]), torch.tensor([[0.0, 4.0], [3.0, 2.0]])
    assert value_loss(values, returns).item() == (1 + 0) / 2 + (16 + 0) / 2


@pytest.mark.parametrize(
    ("rate", "kl", "expected"),
    [
        (3e-4, 0.05, 2e-4),
        (3e-4, 0.001, 4.5e-4),
        (3e-4, 0.015, 3e-4),
        (3e-4, 0.0, 3e-4),
        (1e-4, 0.05, 1e-4),
        (9e-4, 0.001, 1e-3),
    ],
)
def test_the_learning_rate_follows_the_divergence_within_limits(rate, kl, expected):
    rate, kl = torch.tensor(rate), torch.tensor(kl)
    adapted = adapt_learning_rate(rate, kl, desired_kl=0.01, limits=(1e-4, 1e-3))
    assert adapted.item() == pytest.approx(expected)


def test_the_discriminator_is_pulled_to_plus_and_minus_one():
    expert, policy = torch.tensor([1.0, 0.0, 2.0]), torch.tensor([-1.0, 2.0, 100.0])
    loss = discriminator_loss(expert, policy, weights_of(torch.tensor([True, True, False])))
    assert loss.item() == pytest.approx((0 + 1 + 1) / 3 + (0 + 9) / 2)


def test_without_a_valid_pair_only_experts_count():
    loss = discriminator_loss(torch.zeros(2), torch.full((2,), 9.0), weights_of(torch.zeros(2)))
    assert loss.item() == 1.0


def test_the_gradient_penalty_is_the_squared_slope_in_the_features_that_count():
    line = torch.nn.Linear(3, 1)
    line.weight.data = torch.tensor([[1.0, 2.0, 3.0]])
    penalty = gradient_penalty(
        lambda x: line(x).squeeze(1), torch.randn(5, 3), torch.tensor([True, True, False])
    )
    assert penalty.item() == 1.0 + 4.0


def test_the_divergence_of_gaussians_is_that_of_torch():
    mean, log_var, prior_mean, prior_log_var = torch.randn(4, 7, 3).unbind()
    q, p = Normal(mean, (log_var / 2).exp()), Normal(prior_mean, (prior_log_var / 2).exp())
    expected = kl_divergence(q, p).sum(-1)
    torch.testing.assert_close(gaussian_kl(mean, log_var, prior_mean, prior_log_var), expected)


def test_rows_outside_the_mask_do_not_count():
    prediction, target = torch.tensor([[1.0, 2.0], [9.0, 9.0]]), torch.zeros(2, 2)
    some, none = weights_of(torch.tensor([True, False])), weights_of(torch.zeros(2).bool())
    assert weighted_mse(prediction, target, some).item() == (1 + 4) / 2
    assert weighted_mse(prediction, target, none).item() == 0.0
