"""Batches divided among threads against the same batch as a whole."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from kiras_rl.shards import LEAST_ROWS, apply, differentiate

ROWS = 2 * LEAST_ROWS + 1  # shares of different sizes


@pytest.fixture(params=[2, 3, 7])
def threads(request):
    """Let torch have so many threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


class Regression:
    """A network and its loss, which counts the rows of every call."""

    def __init__(self) -> None:
        self.net = nn.Sequential(nn.Linear(3, 16), nn.ELU(), nn.Linear(16, 1))
        self.calls = []

    def loss(self, x, y):
        self.calls.append(len(x))
        error = self.net(x).squeeze(1) - y
        return error.square().mean(), torch.stack([error.mean(), x.mean()])


def batch(rows):
    return {"x": torch.randn(rows, 3), "y": torch.randn(rows)}


def test_gradients_and_numbers_are_those_of_the_whole_batch(threads):
    regression, whole = Regression(), batch(ROWS)
    loss, numbers = regression.loss(**whole)
    loss.backward()
    expected = [p.grad for p in regression.net.parameters()]
    for parameter in regression.net.parameters():
        parameter.grad = torch.full_like(parameter, 9.0)  # of the step before

    with torch.no_grad():  # whoever calls need not think of it
        found = differentiate(regression.loss, whole, regression.net.parameters())
    assert sorted(regression.calls[1:]) == [LEAST_ROWS, LEAST_ROWS + 1]
    torch.testing.assert_close(found, numbers)
    assert not found.requires_grad
    for parameter, gradient in zip(regression.net.parameters(), expected, strict=True):
        torch.testing.assert_close(parameter.grad, gradient, rtol=1e-5, atol=1e-7)
    assert torch.get_num_threads() == threads


def test_rows_come_back_in_their_order(threads):
    x = torch.randn(4 * LEAST_ROWS + 3, 5)
    shares = []

    def double(x):
        shares.append(len(x))
        return 2.0 * x

    assert torch.equal(apply(double, {"x": x}), 2.0 * x)
    assert len(shares) == min(threads, 4)


def test_a_small_batch_is_not_divided(threads):
    regression = Regression()
    differentiate(regression.loss, batch(2 * LEAST_ROWS - 1), regression.net.parameters())
    assert regression.calls == [2 * LEAST_ROWS - 1]


def test_one_thread_does_not_divide():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    regression = Regression()
    differentiate(regression.loss, batch(ROWS), regression.net.parameters())
    torch.set_num_threads(before)
    assert regression.calls == [ROWS]


def test_an_error_in_a_share_is_the_caller_s(threads):
    def fail(x):
        raise ValueError(f"{len(x)} rows")

    with pytest.raises(ValueError, match=f"{ROWS - LEAST_ROWS} rows"):
        apply(fail, {"x": torch.zeros(ROWS, 1)})
    assert torch.get_num_threads() == threads


def test_the_same_threads_give_the_same_bits(threads):
    regression, whole = Regression(), batch(4 * LEAST_ROWS)
    parameters = list(regression.net.parameters())
    differentiate(regression.loss, whole, parameters)
    first = [p.grad for p in parameters]
    for _ in range(5):
        differentiate(regression.loss, whole, parameters)
        assert all(torch.equal(p.grad, g) for p, g in zip(parameters, first, strict=True))
