"""How near a training iteration is to what physics and arithmetic alone would take.

The bound is bare MuJoCo over the same control steps, plus the matrix products of the update at the
rate at which this machine multiplies matrices of their shapes. What is above it is everything else
that an iteration does: observations, rewards, inference, element-wise arithmetic, Python.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce, wraps
from itertools import pairwise
from statistics import median
from typing import Any

import torch
from rich.table import Table
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

from kiras_rl.phases import plan
from kiras_rl.process import single_threaded
from kiras_rl.schema import LearnerConfig
from kiras_rl.tools.benchmarks.request import Figures, Request, native
from kiras_rl.tools.benchmarks.tables import make_table, verdict, with_range
from kiras_rl.tools.benchmarks.timing import child, interleave, summarise
from kiras_rl.tools.benchmarks.training import Training
from kiras_rl.tools.benchmarks.workload import bare_steps

ITERATION, PHYSICS = "iteration", "bare physics"
TARGET = 0.85  # of the bound's speed
UPDATES = (
    ("policy", "_update_policy"),
    ("estimator", "parts.estimator.update"),
    ("discriminator", "parts.imitation.update"),
)
"""(network, method of the learner that trains it)."""

_LEAST_OPERATIONS = 2e10  # of a timed run of matrix products: tens of milliseconds on two cores


@dataclass(frozen=True)
class Product:
    """A layer on a batch, forward and backward: (rows, inner) x (inner, outer)."""

    rows: int
    inner: int
    outer: int

    @property
    def name(self) -> str:
        """How it is called in tables and figures."""
        return f"{self.rows} x {self.inner} x {self.outer}"

    @property
    def operations(self) -> int:
        """Floating point operations of its three products: outputs, gradients of both factors."""
        return 3 * 2 * self.rows * self.inner * self.outer

    def timed(self) -> Callable[[], float]:
        """Return a function that multiplies and returns the seconds of one floating operation."""
        x, y = torch.randn(self.rows, self.inner), torch.randn(self.rows, self.outer)
        weight, d_x = torch.randn(self.inner, self.outer), torch.empty(self.rows, self.inner)
        out, d_weight = torch.empty_like(y), torch.empty_like(weight)
        repeats = max(1, round(_LEAST_OPERATIONS / self.operations))

        def run() -> float:
            begin = time.perf_counter()
            for _ in range(repeats):
                torch.mm(x, weight, out=out)
                torch.mm(y, weight.T, out=d_x)
                torch.mm(x.T, y, out=d_weight)
            return (time.perf_counter() - begin) / (repeats * self.operations)

        return run


def measure(request: Request) -> Figures:
    """Time iterations, bare physics and matrix products in turns; native backend, all threads.

    Raises:
        ConfigError: As `make_env`.
        RobotError: As `make_env`.
    """
    config = native(request.config)
    training = Training(plan(config)[0], "cpu")
    targets = training.record_targets()
    operations = count_operations(training)
    shapes = _shapes(config.learner, config.num_envs)
    products = {shapes[network].name: shapes[network] for network in operations}
    variants = {
        ITERATION: training.iterate,
        PHYSICS: bare_steps(training.env, training.state, targets, config.sim),
    }
    variants |= {name: product.timed() for name, product in products.items()}
    times = interleave(variants, request.rounds)
    physics = [len(targets) * seconds for seconds in times[PHYSICS]]
    updates = {
        network: [count * seconds for seconds in times[shapes[network].name]]
        for network, count in operations.items()
    }
    bounds = [sum(terms) for terms in zip(physics, *updates.values(), strict=True)]
    shares = [bound / whole for bound, whole in zip(bounds, times[ITERATION], strict=True)]
    return {
        "worlds": config.num_envs,
        "num_steps": len(targets),
        "operations": operations,
        "shapes": {network: shapes[network].name for network in operations},
        "operations_per_second": {name: 1.0 / median(times[name]) for name in products},
        "seconds": {
            ITERATION: median(times[ITERATION]),
            PHYSICS: median(physics),
            **{network: median(seconds) for network, seconds in updates.items()},
            "bound": median(bounds),
        },
        "share_of_bound": summarise(shares),
        "target": TARGET,
        "rounds": times,
    }


def count_operations(training: Training) -> dict[str, int]:
    """Return the floating point operations of all matrix products of an update, by network.

    Counted while it runs, backward passes and the gradient penalty included.
    """
    alg, counts, wrapped = training.runner.alg, {}, []
    for network, path in UPDATES:
        *owners, method = path.split(".")
        owner = reduce(child, owners, alg)
        if owner is not None:
            setattr(owner, method, _counted(getattr(owner, method), network, counts))
            wrapped.append((owner, method))
    with single_threaded("cpu"):  # the counter sees one thread
        training.iterate()
    for owner, method in wrapped:
        delattr(owner, method)
    return counts


def _counted(function: Callable, network: str, counts: dict[str, int]) -> Callable:
    @wraps(function)
    def run(*args: Any, **kwargs: Any) -> Any:
        with _ProductCounter() as counter:
            result = function(*args, **kwargs)
        counts[network] = counter.operations
        return result

    return run


class _ProductCounter(TorchDispatchMode):
    """Counts by torch's own formulas, as its FlopCounterMode does.

    That one also follows which module calls, and so refuses the gradient of a gradient.
    """

    def __init__(self) -> None:
        super().__init__()
        self.operations = 0

    def __torch_dispatch__(
        self, function: Any, types: Any, args: tuple = (), kwargs: dict | None = None
    ) -> Any:
        kwargs = kwargs or {}
        result = function(*args, **kwargs)
        formula = flop_registry.get(function._overloadpacket)
        self.operations += formula(*args, **kwargs, out_val=result) if formula else 0
        return result


def _shapes(learner: LearnerConfig, num_envs: int) -> dict[str, Product]:
    """Return the largest product of each network on the batch that it is trained with."""
    ppo = learner.ppo
    rows = ppo.num_steps * num_envs // ppo.num_mini_batches
    policy = Product(rows, *_widest(ppo.actor_dims))
    shapes = {"policy": policy, "estimator": policy}  # as many rows, and widths near these
    if learner.imitation:
        discriminator = learner.imitation.discriminator
        pairs = 2 * discriminator.batch_size  # expert and policy
        shapes["discriminator"] = Product(pairs, *_widest(discriminator.hidden_dims))
    return shapes


def _widest(dims: list[int]) -> tuple[int, int]:
    """Return the neighbouring hidden widths with the largest product."""
    pairs = list(pairwise(dims)) or [(dims[0], dims[0])]
    return max(pairs, key=lambda pair: pair[0] * pair[1])


def table(figures: Figures) -> list[Table]:
    """Return the terms of the bound, and the iteration against it."""
    seconds, rates = figures["seconds"], figures["operations_per_second"]
    title = f"an iteration of {figures['worlds']} worlds x {figures['num_steps']} steps"
    terms = make_table(title, "GFLOP", "GFLOP/s", "products", "s")
    terms.add_row(PHYSICS, "", "", "", f"{seconds[PHYSICS]:.3f}")
    for network, count in figures["operations"].items():
        shape = figures["shapes"][network]
        row = (f"{count / 1e9:.2f}", f"{rates[shape] / 1e9:.1f}", shape)
        terms.add_row(f"update of the {network}", *row, f"{seconds[network]:.3f}")
    terms.add_row("bound, their sum", "", "", "", f"{seconds['bound']:.3f}")
    terms.add_row(ITERATION, "", "", "", f"{seconds[ITERATION]:.3f}")
    share, target = figures["share_of_bound"], figures["target"]
    reached = "bound / iteration: {} ({})".format(*with_range(share))
    terms.caption = f"{reached}\n{verdict(share['median'] >= target, f'target: at least {target}')}"
    return [terms]
