"""What a step of the environment asks of a GPU, counted on a CPU: few operations, never a wait.

On the warp backend every torch operation that makes a tensor is a kernel launch or two, and small
batches are bound by their number. What depends on the values of a tensor makes the host wait for
the GPU: reading a number, finding the true elements of a mask, indexing by a mask.
"""

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from kiras_rl.config import load_config
from kiras_rl.envs import make_env
from kiras_rl.phases import FINETUNING, SKILL_LEARNING, phase_of

LIMITS = {SKILL_LEARNING: 575, FINETUNING: 1110}
"""Operations of a step at most: those of today, and a few for terms to come."""

WAITS = {
    *("_local_scalar_dense", "nonzero", "masked_select", "unique_dim", "_unique2", "equal"),
    *("repeat_interleave.Tensor", "bincount", "lift_fresh"),
}
"""Operations that wait on a GPU. `lift_fresh` is a tensor made of Python numbers: a copy."""

VIEWS = {"_unsafe_view"}  # they are not marked as views, and launch nothing either


class Operations(TorchDispatchMode):
    """Counts operations that make something, and names those that would wait.

    Attributes:
        count: Operations that are no views.
        waits: Names of those that wait.
    """

    def __init__(self):
        super().__init__()
        self.count, self.waits = 0, []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        """Run an operation and note it."""
        result = function(*args, **kwargs or {})
        name = function._schema.name.removeprefix("aten::")
        if name in WAITS or str(function).removeprefix("aten.") in WAITS or by_mask(name, args):
            self.waits.append(str(function))
        self.count += not (function.is_view or name in VIEWS)
        return result


def by_mask(name, args):
    """Tell whether an operation indexes by a mask: its shape would depend on the values."""
    if name not in ("index", "index_put_", "index_put", "_index_put_impl_"):
        return False
    return any(index is not None and index.dtype == torch.bool for index in args[1])


def count(function, *args):
    with Operations() as operations:
        function(*args)
    return operations


@pytest.fixture(scope="module", params=[SKILL_LEARNING, FINETUNING])
def phase(request):
    """A phase, and its environment on the warp backend after a first step, every part in it."""
    overrides = ("num_envs=4", "finetuning.env.terrain={levels: 2, variants: 1}")
    config = load_config("solo8", [*overrides, "sim.backend=warp", "device=cpu"])
    env = make_env(phase_of(config, request.param).config)
    env.step(torch.zeros(4, env.num_actions))
    return request.param, env


def test_a_step_is_few_operations_and_waits_for_nothing(phase):
    name, env = phase
    env.episode_length_buf = torch.full((4,), env.max_episode_length)  # all reset
    operations = count(env.step, torch.zeros(4, env.num_actions))
    assert operations.waits == []
    assert LIMITS[name] - 20 <= operations.count <= LIMITS[name]


def test_resets_take_no_more_operations(phase):
    _, env = phase
    actions, dones = torch.zeros(4, env.num_actions), []

    def step():
        dones.append(env.step(actions)[2])

    env.episode_length_buf = torch.zeros(4)
    going_on = count(step)
    env.episode_length_buf = torch.full((4,), env.max_episode_length)
    ending = count(step)
    assert [done.tolist() for done in dones] == [[False] * 4, [True] * 4]
    assert ending.count == going_on.count


X, MASK = torch.arange(4.0), torch.tensor([True, False, True, False])


@pytest.mark.parametrize(
    "wait",
    [
        lambda: X[0].item(),
        lambda: bool(MASK.any()),
        lambda: MASK.nonzero(),
        lambda: X[MASK],
        lambda: X.masked_select(MASK),
        lambda: X.unique(),
        lambda: X.clone().__setitem__(MASK, torch.ones(2)),
        lambda: X.repeat_interleave(torch.ones(4, dtype=torch.int64)),
        lambda: torch.tensor([1.0, 2.0]),
    ],
)
def test_what_waits_is_found(wait):
    assert count(wait).waits


def test_what_does_not_wait_is_only_counted():
    index = torch.tensor([1, 0])

    def work():
        torch.where(MASK, X, 0.0 * X)  # 2
        X[index].view(2, 1)  # 1, and a view
        X.masked_fill(MASK, 1.0)  # 1

    operations = count(work)
    assert operations.waits == []
    assert operations.count == 4
