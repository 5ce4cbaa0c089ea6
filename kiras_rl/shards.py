"""Large batches on a CPU: every thread takes a share of the rows, from the inputs to the gradients.

torch by itself divides each single operation among its threads, which then wait for each other; in
networks as small as these that takes as long as the arithmetic. Here they wait once a batch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

import torch
from torch import nn

from kiras_rl.process import threads_of_torch

T = TypeVar("T")
Batch = Mapping[str, torch.Tensor]

MOST = 4  # threads: Python itself runs in one of them at a time
LEAST_ROWS = 512  # of a share; with fewer, starting the threads takes longer than the work


def differentiate(
    loss_of: Callable[..., tuple[torch.Tensor, torch.Tensor]],
    batch: Batch,
    parameters: Iterable[nn.Parameter],
) -> torch.Tensor:
    """Set the gradients of a loss that is a mean over the rows; return what describes it.

    Args:
        loss_of: Takes the tensors of a batch by their names, or rows of them; returns the loss and
            a vector of numbers, (k,), which are means over the rows, too. It must not draw random
            numbers: several threads are in it.
        batch: Tensors of the same number of rows.
        parameters: What the loss depends on.

    Returns:
        The numbers for the whole batch, (k,), without gradient.
    """
    parameters = list(parameters)
    rows = _rows(batch)

    def work(share: Batch) -> tuple[tuple[torch.Tensor, ...], torch.Tensor]:
        weight = _rows(share) / rows
        with torch.enable_grad():
            loss, numbers = loss_of(**share)
            return torch.autograd.grad(weight * loss, parameters), weight * numbers.detach()

    gradients, numbers = zip(*_map(work, batch), strict=True)
    for parameter, *parts in zip(parameters, *gradients, strict=True):
        parameter.grad = _sum(parts)
    return _sum(numbers)


def apply(function: Callable[..., torch.Tensor], batch: Batch) -> torch.Tensor:
    """Return what a function makes of every row, without gradient.

    Args:
        function: Takes the tensors of a batch by their names, or rows of them; returns one with as
            many rows, and draws no random numbers.
        batch: Tensors of the same number of rows.
    """

    def work(share: Batch) -> torch.Tensor:
        with torch.no_grad():
            return function(**share)

    return torch.cat(_map(work, batch))


def _map(work: Callable[[Batch], T], batch: Batch) -> list[T]:
    """Return what comes of each share of the rows, in their order."""
    threads = torch.get_num_threads() if _device(batch).type == "cpu" else 1
    count = min(threads, MOST, _rows(batch) // LEAST_ROWS)
    if count <= 1:
        return [work(batch)]
    shares = [
        dict(zip(batch, parts, strict=True))
        for parts in zip(*(x.tensor_split(count) for x in batch.values()), strict=True)
    ]
    with threads_of_torch(threads // count):
        return list(_pool(count, threads // count).map(work, shares))


@cache
def _pool(count: int, threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, "shard", torch.set_num_threads, (threads,))


def _sum(tensors: Iterable[torch.Tensor]) -> torch.Tensor:
    first, *others = tensors
    for other in others:
        first = first + other
    return first


def _rows(batch: Batch) -> int:
    return len(next(iter(batch.values())))


def _device(batch: Batch) -> torch.device:
    return next(iter(batch.values())).device
