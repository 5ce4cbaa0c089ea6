"""How fast a policy was learned: skills that meet the floor, against steps and against time."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from matplotlib.axes import Axes

from kiras_rl.config import ConfigError
from kiras_rl.evaluation.flat import FLOOR, SkillResult
from kiras_rl.schema import Config
from kiras_rl.tools.evaluation.protocols.rows import colours, panels
from kiras_rl.tools.evaluation.protocols.sampling import run_of
from kiras_rl.tools.evaluation.protocols.subject import Subject
from kiras_rl.tools.evaluation.report.content import Cell, Column, Figure, Section, Table
from kiras_rl.tools.training.curves import Series, read_scalars

TITLE = "Learning"
TEXT = (
    "The evaluations without action noise beside the training, on flat ground, until the end of "
    "skill learning: few robots a skill, so curves are rough. Minutes are those of rollouts and "
    "updates, on the machine that trained. Where there are several seeds, lines are their mean and "
    "bands their range."
)

PANELS = (
    ("skills that meet the floor", "at_floor"),
    ("height error [cm]", "height_error"),
    ("error of v_x [m/s]", "velocity_error"),
)
SPEED = "Perf/steps_per_second"
TIMES = tuple(f"Perf/{part}_time" for part in ("physics", "environment", "inference", "learning"))
"""Of an iteration, without its evaluation, s."""

COLUMNS = (
    Column("policy"),
    Column("seeds", form="{}"),
    Column("all skills first at the floor", "M steps", "{:.1f}", best="low"),
    Column("after", "min", "{:.1f}", best="low"),
    Column("skills at the floor at the end", form="{:.1f}", best="high"),
    Column("height error at the end", "cm", "{:.1f}", best="low"),
    Column("v_x error at the end", "m/s", "{:.2f}", best="low"),
)


def measure(subject: Subject) -> dict:
    """Return the curves of skill learning, from the log of the policy's run.

    Raises:
        ConfigError: The policy lies in no run, or its run evaluated nothing on flat ground.
    """
    run = run_of(subject.source)
    if run is None:
        raise ConfigError(
            f"learning: {subject.source} lies in no run folder; name the run that trained it"
        )
    log, config = read_scalars(run), subject.run
    at = _evaluated(log, subject)
    if not at:
        raise ConfigError(
            f"learning: the log of {run} holds no evaluation of skill learning: it is too young, "
            "began with --flat, or evaluation.interval=0 left them out"
        )
    steps, minutes = _pace(log, config, at)
    results = [_results(log, subject.skills, iteration) for iteration in at]
    return {
        "skills": len(subject.skills),
        "curves": [
            {
                "steps": steps,
                "minutes": minutes,
                "at_floor": [sum(r.meets(FLOOR) for r in skills) for skills in results],
                "height_error": [100 * _mean(skills, "height_error") for skills in results],
                "velocity_error": [_mean(skills, "velocity_error") for skills in results],
            }
        ],
    }


def is_known(subject: Subject) -> bool:
    """Return whether the policy lies in a run that evaluated its skill learning."""
    run = run_of(subject.source)
    return run is not None and bool(_evaluated(read_scalars(run), subject))


def _evaluated(log: Series, subject: Subject) -> list[int]:
    """Return the iterations of skill learning after which the policy was evaluated."""
    iterations, _ = log.get(f"Eval_{subject.skills[0]}/height", ([], []))
    return [iteration for iteration in iterations if iteration <= subject.run.iterations]


def _pace(log: Series, config: Config, at: list[int]) -> tuple[list[float], list[float]]:
    """Return the million steps of all ranks and the minutes that the iterations `at` took."""
    seconds = sum(np.array(log[tag][1]) for tag in TIMES)
    share = config.num_envs * config.learner.ppo.num_steps  # of one rank
    steps = share * round(np.median(seconds * log[SPEED][1]) / share)
    minutes = np.interp(at, log[SPEED][0], np.cumsum(seconds) / 60)
    return [iteration * steps / 1e6 for iteration in at], minutes.tolist()


def _results(log: Series, skills: tuple[str, ...], iteration: int) -> list[SkillResult]:
    """Return what an evaluation said of each skill."""

    def value(tag: str) -> float:
        iterations, values = log[tag]
        return values[iterations.index(iteration)]

    names = [field.name for field in fields(SkillResult)]
    return [SkillResult(**{n: value(f"Eval_{skill}/{n}") for n in names}) for skill in skills]


def _mean(results: list[SkillResult], name: str) -> float:
    return sum(getattr(result, name) for result in results) / len(results)


def section(results: dict[str, dict]) -> Section:
    """Return when all skills were first at the floor, and the curves."""
    table = Table(
        "When the skills were learned", COLUMNS, [_row(*item) for item in results.items()]
    )
    figures = [_figure(results, "steps", "M environment steps"), _figure(results, "minutes", "min")]
    return Section("learning", TITLE, TEXT, [table], figures)


def _row(label: str, values: dict) -> tuple[Cell, ...]:
    """Return means over the seeds; nothing where one of them has not come to the floor."""
    curves, skills = values["curves"], values["skills"]
    reached = [next((i for i, n in enumerate(c["at_floor"]) if n == skills), None) for c in curves]

    def first(axis: str) -> float | None:
        if None in reached:
            return None
        return float(np.mean([c[axis][i] for c, i in zip(curves, reached, strict=True)]))

    ends = [float(np.mean([c[name][-1] for c in curves])) for _, name in PANELS]
    return label, len(curves), first("steps"), first("minutes"), *ends


def _figure(results: dict[str, dict], axis: str, unit: str) -> Figure:
    drawing, axes = panels(len(PANELS), width=4.0, height=3.0, share=False)
    for panel, (title, name) in zip(axes, PANELS, strict=True):
        for (label, values), colour in zip(results.items(), colours(), strict=False):
            _draw(panel, values["curves"], axis, name, label, colour)
        panel.set(title=title, xlabel=unit, ylim=(0, None))
    axes[0].legend(fontsize=7)
    return Figure(f"Learning over {'time' if axis == 'minutes' else 'steps'}", drawing)


def _draw(panel: Axes, curves: list[dict], axis: str, name: str, label: str, colour: str) -> None:
    """Draw the mean of several seeds and their range, as far as all of them go."""
    grid = np.linspace(max(c[axis][0] for c in curves), min(c[axis][-1] for c in curves), 200)
    seeds = np.stack([np.interp(grid, c[axis], c[name]) for c in curves])
    panel.fill_between(grid, seeds.min(0), seeds.max(0), color=colour, alpha=0.15, linewidth=0)
    panel.plot(grid, seeds.mean(0), color=colour, linewidth=1.4, label=label)
