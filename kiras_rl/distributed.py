"""The ranks of a training: processes, one a GPU or a share of the cores, that train one run.

torchrun starts them and tells each in its environment who it is. Every rank simulates worlds of its
own; gradients, statistics and decisions are those of all. Where there is one process, each function
here returns what it is given, and no collective call is made.

A collective call (every function from `total` on) is made by all ranks, in the same order.
"""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from rsl_rl.utils.utils import reduce_gradients_in_buckets
from torch import nn

T = TypeVar("T")

TIMEOUT = timedelta(minutes=10)
"""Of a collective call: the others wait in one while rank 0 evaluates, exports or saves."""

_BUCKET = 25.0  # MB of gradients that are sent together


class RankLostError(RuntimeError):
    """Another rank does not answer: it died, or it hangs."""


# --- who is who ----------------------------------------------------------------------------------


@contextmanager
def group() -> Iterator[None]:
    """Join the ranks that torchrun started, if it did; leave them when all is done.

    Inside of another one it does nothing: a second group would meet the addresses of the first.

    Raises:
        RankLostError: The others cannot be reached.
    """
    if dist.is_initialized() or int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield
        return
    backend = "gloo"
    if torch.cuda.is_available():
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")) % torch.cuda.device_count())
        backend = "cpu:gloo,cuda:nccl"  # flags and objects stay on the CPU
    _call(dist.init_process_group, backend, timeout=TIMEOUT)
    torch.set_num_threads(core_share())
    yield
    dist.destroy_process_group()  # not after an error: it would wait for the dead


def size() -> int:
    """Return how many ranks there are."""
    return dist.get_world_size() if dist.is_initialized() else 1


def rank() -> int:
    """Return which of all ranks this is."""
    return dist.get_rank() if dist.is_initialized() else 0


def is_main() -> bool:
    """Tell whether this is rank 0, which alone writes, prints and evaluates."""
    return rank() == 0


def local_size() -> int:
    """Return how many ranks share this machine."""
    return int(os.environ.get("LOCAL_WORLD_SIZE", "1")) if dist.is_initialized() else 1


def local_rank() -> int:
    """Return which of this machine's ranks this is."""
    return int(os.environ.get("LOCAL_RANK", "0")) if dist.is_initialized() else 0


def core_share() -> int:
    """Return how many cores each rank of this machine has; 0, for all of them, if it is alone."""
    if not dist.is_initialized():
        return 0
    return max(1, len(os.sched_getaffinity(0)) // local_size())


# --- tensors -------------------------------------------------------------------------------------


def total(values: torch.Tensor) -> torch.Tensor:
    """Return the sum over the ranks, of the same shape, without gradient."""
    if size() == 1:
        return values
    summed = values.detach().clone()
    _call(dist.all_reduce, summed)
    return summed


def mean(values: torch.Tensor) -> torch.Tensor:
    """Return the mean over the ranks, of the same shape, without gradient."""
    return values if size() == 1 else total(values) / size()


def gather(values: torch.Tensor, dim: int = 0) -> torch.Tensor:
    """Return the tensors of all ranks, in their order, joined along a dimension."""
    if size() == 1:
        return values
    values = values.detach().contiguous()
    parts = [torch.empty_like(values) for _ in range(size())]
    _call(dist.all_gather, parts, values)
    return torch.cat(parts, dim=dim)


def broadcast(values: torch.Tensor) -> torch.Tensor:
    """Overwrite a tensor with that of rank 0; return it."""
    if size() > 1:
        _call(dist.broadcast, values, src=0)
    return values


def broadcast_module(module: nn.Module) -> None:
    """Give a network the weights that it has on rank 0."""
    for tensor in module.state_dict().values():
        broadcast(tensor)


def average_gradients(parameters: Iterable[nn.Parameter]) -> None:
    """Replace gradients by their means over the ranks; call it between backward and step."""
    if size() > 1:
        _call(reduce_gradients_in_buckets, parameters, size(), _BUCKET)


# --- numbers, decisions, objects -----------------------------------------------------------------


def any_rank(flag: bool) -> bool:
    """Tell whether a flag is set on any rank."""
    return flag if size() == 1 else bool(total(torch.tensor(int(flag))) > 0)


def mean_scalars(scalars: dict[str, float], summed: tuple[str, ...]) -> dict[str, float]:
    """Return the means over the ranks of numbers that all ranks have under the same names.

    Args:
        scalars: Name -> number.
        summed: Beginnings of the names of counts, which are added up instead.
    """
    if size() == 1:
        return scalars
    sums = total(torch.tensor(list(scalars.values()), dtype=torch.float64)).tolist()
    return {
        name: value if name.startswith(summed) else value / size()
        for name, value in zip(scalars, sums, strict=True)
    }


def from_main(make: Callable[[], T]) -> T:
    """Let rank 0 alone do or make something; return its result, or raise its error, on all ranks.

    `make` must not make a collective call.
    """
    if size() == 1:
        return make()
    outcome: list[Any] = [None, None]
    if is_main():
        try:
            outcome[0] = make()
        except Exception as error:
            outcome[1] = error
    _call(dist.broadcast_object_list, outcome, src=0)
    if outcome[1] is not None:
        raise outcome[1]
    return outcome[0]


def gather_states(state: dict) -> list[dict]:
    """Return the states of all ranks on rank 0, with tensors on the CPU; elsewhere nothing.

    Args:
        state: Tensors, numbers, strings, and containers of them.
    """
    if size() == 1:
        return [state]
    buffer = io.BytesIO()
    torch.save(state, buffer)  # not pickled as it is: each tensor would land on its own rank's GPU
    received = [b""] * size() if is_main() else None
    _call(dist.gather_object, buffer.getvalue(), received, dst=0)
    return [
        torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
        for content in received or []
    ]


def scatter_states(states: list[T] | None) -> T:
    """Return to each rank its own of the states that rank 0 gives, one a rank, in their order."""
    if size() == 1:
        assert states is not None
        return states[0]
    own: list[Any] = [None]
    _call(dist.scatter_object_list, own, states if is_main() else None, src=0)
    return own[0]


def _call(collective: Callable, *args: Any, **kwargs: Any) -> None:
    try:
        collective(*args, **kwargs)
    except RuntimeError as error:
        raise RankLostError(
            f"rank {os.environ['RANK']} of {os.environ['WORLD_SIZE']}: another rank died or did "
            f"not answer within {TIMEOUT.seconds // 60} minutes ({str(error).splitlines()[0]})"
        ) from error
