"""A stand-in for CUDA graphs: it records torch operations and repeats them on the same memory."""

import torch
from torch.utils._python_dispatch import TorchDispatchMode

WAITING = ("_local_scalar_dense", "nonzero", "masked_select", "normal")
"""Operations that read values of the device on the host: no graph can hold them."""


class Tape(TorchDispatchMode):
    """Stands in for torch.cuda.CUDAGraph and torch.cuda.graph: memory stays, operations repeat."""

    def __init__(self):
        super().__init__()
        self._calls, self._before = [], {}

    def __enter__(self):
        """Remember where random numbers were."""
        self._random = torch.get_rng_state()
        return super().__enter__()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        """Run an operation and note it; what it writes to is remembered as it was."""
        kwargs = kwargs or {}
        if function.overloadpacket.__name__ in WAITING:
            raise RuntimeError(f"{function} waits for the device")
        for argument, value in zip(function._schema.arguments, [*args, *[None] * 9], strict=False):
            if argument.alias_info is not None and argument.alias_info.is_write:
                value = kwargs.get(argument.name, value)
                for tensor in value if isinstance(value, list | tuple) else [value]:
                    self._before.setdefault(id(tensor), (tensor, tensor.clone()))
        result = function(*args, **kwargs)
        if not function.is_view and function.namespace == "aten":
            self._calls.append((function, args, kwargs, result))
        return result

    def __exit__(self, *error):
        """Undo the recorded run: a graph that is recorded computes nothing."""
        super().__exit__(*error)
        with torch.no_grad():
            self._undo()

    def _undo(self):
        for tensor, before in reversed(self._before.values()):
            tensor.copy_(before)
        torch.set_rng_state(self._random)

    @torch.no_grad()
    def replay(self):
        """Repeat every operation where it was."""
        for function, args, kwargs, result in self._calls:
            again = function(*args, **kwargs)
            for old, new in zip(flat(result), flat(again), strict=True):
                if old is not new:
                    old.copy_(new)


def flat(result):
    return [result] if isinstance(result, torch.Tensor) else list(result or ())
