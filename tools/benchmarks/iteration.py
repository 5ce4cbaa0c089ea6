"""Where the time of a training iteration goes, in each phase."""

from __future__ import annotations

from statistics import median
from typing import TYPE_CHECKING

from matplotlib import color_sequences
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from kiras_rl.phases import Phase, plan
from kiras_rl.recorded import WARM_UP
from kiras_rl.tools.benchmarks.request import Figures, Request
from kiras_rl.tools.benchmarks.tables import make_table
from kiras_rl.tools.benchmarks.timing import PartTimer, Times
from kiras_rl.tools.benchmarks.training import Training
from kiras_rl.tools.benchmarks.workload import ENVIRONMENT_PARTS

if TYPE_CHECKING:
    from matplotlib.typing import ColorType

REST = "rest"
PARTS = (
    *(
        (f"env.{owner}" if owner else "env", method, part)
        for owner, method, part in ENVIRONMENT_PARTS
    ),
    ("alg", "act", "act"),
    ("alg", "process_env_step", "record"),
    ("alg.parts.imitation", "rewards", "imitation scoring"),
    ("alg.parts.imitation.selector", "record", "premium windows"),
    ("alg.parts.retention", "judge", "residual reward"),
    ("alg", "compute_returns", "returns"),
    ("alg", "_update_policy", "policy update"),
    ("alg.parts.estimator", "update", "estimator"),
    ("alg.parts.imitation", "update", "discriminator"),
)
"""(owner, method, part): what an iteration is divided into; what is none of them is the rest.

On a GPU much of it is inside graphs, which only their caller is timed for.
"""

FIRST_OF_GRAPH = {"rewards, terminations, features": "what follows the physics"}
"""Part -> what it is called where the parts that it calls are in one graph with it."""


def measure(request: Request) -> Figures:
    """Time the parts of an iteration of every phase.

    Raises:
        ConfigError: As `make_env`.
        RobotError: As `make_env`.
    """
    phases = {phase.name: _time_parts(request, phase) for phase in plan(request.config)}
    return {
        "worlds": request.config.num_envs,
        "num_steps": request.config.learner.ppo.num_steps,
        "device": request.device,
        "seconds": {
            phase: {part: median(times) for part, times in parts.items()}
            for phase, parts in phases.items()
        },
        "rounds": phases,
    }


def _time_parts(request: Request, phase: Phase) -> Times:
    """Return the seconds of each part of an iteration, one a round."""
    training = Training(phase, request.device)
    for _ in range(WARM_UP + 1):  # on a GPU graphs are recorded, which waits for nothing
        training.iterate()
    timer = PartTimer(request.device)
    timer.wrap_all(training.runner, PARTS)
    times: Times = {part: [] for part in (*timer.seconds, REST)}
    for _ in range(request.rounds):
        timer.clear()
        whole = training.iterate()
        for part, seconds in timer.seconds.items():
            times[part].append(seconds)
        times[REST].append(whole - sum(timer.seconds.values()))
    if request.device == "cpu":
        return times
    return {FIRST_OF_GRAPH.get(part, part): values for part, values in times.items() if any(values)}


def table(figures: Figures) -> list[Table]:
    """Return a table of all parts, one column a phase."""
    phases = figures["seconds"]
    title = f"an iteration of {figures['worlds']} worlds x {figures['num_steps']} steps"
    columns = [text for phase in phases for text in (f"{_words(phase)}, s", "%")]
    parts = make_table(f"{title} on {figures['device']}", *columns)
    for part in _parts_of(figures):
        row = []
        for seconds in phases.values():
            share = 100 * seconds.get(part, 0.0) / sum(seconds.values())
            row += [f"{seconds[part]:.3f}", f"{share:.1f}"] if part in seconds else ["", ""]
        parts.add_row(part, *row)
    whole = [text for s in phases.values() for text in (f"{sum(s.values()):.3f}", "100.0")]
    parts.add_row("iteration", *whole)
    return [parts]


def _parts_of(figures: Figures) -> list[str]:
    """Return the parts that any phase has, in their order."""
    present = {part for seconds in figures["seconds"].values() for part in seconds}
    named = (name for *_, part in PARTS for name in (part, FIRST_OF_GRAPH.get(part)))
    return [part for part in (*named, REST) if part and part in present]


def plot(figures: Figures) -> Figure:
    """Return a bar of an iteration's parts for each phase."""
    phases = figures["seconds"]
    figure = Figure(figsize=(11, 1.9 + 0.8 * len(phases)), layout="constrained")
    axes = figure.subplots()
    colors = dict(zip(_parts_of(figures), color_sequences["tab20"], strict=False))
    longest = max(sum(seconds.values()) for seconds in phases.values())
    for row, seconds in enumerate(phases.values()):
        _stack(axes, row, seconds, colors, least=0.04 * longest)
    axes.set_yticks(range(len(phases)), [_words(phase) for phase in phases])
    axes.invert_yaxis()
    axes.set_xlabel(
        f"seconds of an iteration: {figures['worlds']} worlds x {figures['num_steps']} steps, "
        f"{figures['device']}"
    )
    handles, labels = axes.get_legend_handles_labels()
    legend = dict(zip(labels, handles, strict=True))
    figure.legend(legend.values(), legend, loc="outside lower center", ncols=5, frameon=False)
    return figure


def _stack(
    axes: Axes, row: int, seconds: dict[str, float], colors: dict[str, ColorType], least: float
) -> None:
    """Draw a bar; parts of less than `least` seconds have no room for a number."""
    left, whole = 0.0, sum(seconds.values())
    for part, width in seconds.items():
        axes.barh(row, width, left=left, color=colors[part], label=part, height=0.6)
        if width > least:
            text = f"{100 * width / whole:.0f} %"
            axes.text(left + width / 2, row, text, ha="center", va="center")
        left += width


def _words(phase: str) -> str:
    return phase.replace("_", " ")
