"""A function of tensors as one CUDA graph: hundreds of small kernels for one launch.

A step of the environment, or of an optimizer, is many operations on small tensors, and on a GPU
each costs the host more time to launch than the device to compute. A graph replays them all at the
addresses that they had when it was recorded. So what goes on from call to call has to stay where it
is, and what a call hands out has to be copied before the next one writes there.
"""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable, Hashable, Iterable
from operator import attrgetter
from typing import Any, Generic, TypeVar

import torch
from torch.utils._pytree import tree_flatten, tree_unflatten

_log = logging.getLogger(__name__)

T = TypeVar("T")
Slot = tuple[object, str]  # an attribute: its owner, and its name with dots

COMPILER: dict[str, Any] = {"unroll_reductions_threshold": 33}
"""Options of torch.compile. Sums over joints, feet and reward terms become additions in a row: the
kernels with a dimension of 8 to reduce, which it would write, crash Triton 3.6 (operand does not
dominate its use, in `tritongpu-remove-layout-conversions`)."""

WARM_UP = 2  # calls before the recording: libraries and optimizers allocate at their first


class Recorded(Generic[T]):
    """Calls a function; on CUDA records it after a few calls and replays it from then on."""

    def __init__(
        self,
        function: Callable[[], T],
        device: torch.device | str,
        carried: Callable[[], Iterable[Slot]] = tuple,
        renewed: Iterable[object] = (),
        variant: Callable[[], Hashable] = tuple,
        enabled: bool = True,
        compiled: bool = False,
    ) -> None:
        """Take the function; nothing is called yet.

        Args:
            function: Reads tensors and returns others, in tuples and dictionaries. Its operations
                depend on no value of a tensor. Random numbers are those of torch's own generator.
            device: Where the tensors are; anywhere but on CUDA the function is simply called.
            carried: Attributes that it reads and replaces. They may be replaced from outside
                between two calls, by tensors of the same shape; no other that it reads may.
            renewed: Objects whose attributes it only replaces, with what others read later.
            variant: What else decides which operations run; a new value is a new recording.
            enabled: False for a function that cannot be recorded: ranks wait for each other in it.
            compiled: Whether torch.compile fuses its operations first, which takes half a minute.
        """
        self._plain, self._carried, self._variant = function, carried, variant
        self._renewed = tuple(renewed)
        self.records = enabled and torch.device(device).type == "cuda"
        self._function = function
        if self.records and compiled:
            self._function = torch.compile(
                function, fullgraph=True, dynamic=False, options=COMPILER
            )
        self._slots: list[tuple[Slot, torch.Tensor]] = []
        self._recording: _Recording[T] | None = None
        self._of: Hashable = None  # of no variant
        self._calls = 0

    def __call__(self) -> T:
        """Return what the function returns, in tensors that no later call changes."""
        if not self.records:
            return self._plain()
        variant = self._variant()
        if variant != self._of:
            self._of, self._calls, self._recording = variant, 0, None
            self._slots = [(slot, attrgetter(slot[1])(slot[0]).clone()) for slot in self._carried()]
        self._calls += 1
        _bind(self._slots)
        if self._calls <= WARM_UP:
            return self._warm_up()
        if self._recording is None:
            self._recording = _Recording(self._function, self._slots, self._renewed)
        return self._recording.replay()

    def _warm_up(self) -> T:
        from torch._dynamo.exc import TorchDynamoException  # a second to import

        try:
            return _aside(self._function)
        except TorchDynamoException as error:  # no compiler for C, say
            reason = " ".join(str(error).split())  # which kernel first, what is wrong with it last
            if len(reason) > 400:
                reason = f"{reason[:100]} ... {reason[-300:]}"
            _log.warning("torch.compile failed, training goes on a little slower: %s", reason)
            self._function = self._plain
            return _aside(self._function)

    def forget(self) -> None:
        """Record anew: tensors that the function reads and that are not carried were replaced."""
        self._of = None


class _Recording(Generic[T]):
    """A graph, the tensors that it reads and replaces, and those that it returns."""

    def __init__(
        self,
        function: Callable[[], T],
        slots: list[tuple[Slot, torch.Tensor]],
        renewed: tuple[object, ...],
    ) -> None:
        gc.collect()  # what a finalizer frees would become part of the recording
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            self._outputs, self._structure = tree_flatten(function())
            _bind(slots)
        self._after = [(owner, dict(vars(owner))) for owner in renewed]

    def replay(self) -> T:
        self._graph.replay()
        for owner, attributes in self._after:
            vars(owner).update(attributes)
        return tree_unflatten(_copies(self._outputs), self._structure)


def _bind(slots: list[tuple[Slot, torch.Tensor]]) -> None:
    """Bring what was replaced, from outside or by the function, to where it is read."""
    current = [(attrgetter(slot[1])(slot[0]), slot, tensor) for slot, tensor in slots]
    replaced = [(value, slot, tensor) for value, slot, tensor in current if value is not tensor]
    # Copies first: one value may be what another one overwrites, or a view of it.
    values = _copies([value for value, _, _ in replaced])
    _copy_all([tensor for _, _, tensor in replaced], values)
    for _, slot, tensor in replaced:
        _set(slot, tensor)


def _aside(function: Callable[[], T]) -> T:
    """Call on a stream of its own: what autograd remembers of the main one cannot be recorded."""
    if not torch.cuda.is_available():
        return function()
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        result = function()
    torch.cuda.current_stream().wait_stream(stream)
    return result


def _set(slot: Slot, value: torch.Tensor) -> None:
    owner, (*path, name) = slot[0], slot[1].split(".")
    for step in path:
        owner = getattr(owner, step)
    setattr(owner, name, value)


def copied(tree: T) -> T:
    """Return nested tuples and dictionaries with copies of their tensors."""
    leaves, structure = tree_flatten(tree)
    where = [i for i, leaf in enumerate(leaves) if isinstance(leaf, torch.Tensor)]
    for i, copy in zip(where, _copies([leaves[i] for i in where]), strict=True):
        leaves[i] = copy
    return tree_unflatten(leaves, structure)


def _copies(tensors: list[torch.Tensor]) -> list[torch.Tensor]:
    """Return copies; those of numbers by few kernels for all."""
    copies = [torch.empty_like(tensor) for tensor in tensors]
    _copy_all(copies, tensors)
    return copies


def _copy_all(targets: list[torch.Tensor], values: list[torch.Tensor]) -> None:
    for dtype in {value.dtype for value in values}:
        group = [i for i, value in enumerate(values) if value.dtype == dtype]
        torch._foreach_copy_(  # pyright: ignore[reportPrivateImportUsage], no other takes lists
            [targets[i] for i in group], [values[i] for i in group]
        )
