"""With which probability each skill was practised, over the training."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from kiras_rl.config import ConfigError
from kiras_rl.tools.evaluation.protocols.rows import colours, panels
from kiras_rl.tools.evaluation.protocols.subject import Subject
from kiras_rl.tools.evaluation.report.content import Column, Figure, Section, Table
from kiras_rl.tools.training.curves import read_scalars

TITLE = "Skill sampling"
TEXT = (
    "Skill Initialization draws the skills that the critic holds to be learned least more often. "
    "The probabilities are those of the training's log; where there are several seeds, their mean "
    "and range."
)

POINTS = 200  # of a curve


def measure(subject: Subject) -> dict:
    """Return the probabilities over the iterations, from the log of the policy's run.

    Raises:
        ConfigError: The policy lies in no run, or its run draws skills uniformly.
    """
    run = run_of(subject.source)
    if run is None:
        raise ConfigError(
            f"sampling: {subject.source} lies in no run folder; name the run that trained it"
        )
    log = read_scalars(run)
    tags = {name: f"Skill/probability_{name}" for name in subject.skills}
    if not all(tag in log for tag in tags.values()):
        raise ConfigError(
            f"sampling: the log of {run} holds no skill probabilities (learner.skill_init=null "
            "draws skills uniformly)"
        )
    return {
        "first_phase": subject.run.iterations,
        "curves": [{name: list(zip(*log[tag], strict=True)) for name, tag in tags.items()}],
    }


def is_known(subject: Subject) -> bool:
    """Return whether the policy lies in a run that did not draw its skills uniformly."""
    return run_of(subject.source) is not None and subject.run.learner.skill_init is not None


def run_of(source: Path) -> Path | None:
    """Return the run folder of a policy file, None where it lies in none."""
    for folder in (source.parent, source.parent.parent):
        if (folder / "config.yaml").is_file() and any(folder.glob("events.*")):
            return folder
    return None


def section(results: dict[str, dict]) -> Section:
    """Return the curves, and the probabilities at the ends of the phases."""
    skills = list(next(iter(results.values()))["curves"][0])
    rows = [
        (label, skill, *_shares(values, skill))
        for label, values in results.items()
        for skill in skills
    ]
    columns = (
        Column("policy"),
        Column("skill"),
        Column("at 25 % of skill learning", "%", "{:.0f}"),
        Column("at 75 %", "%", "{:.0f}"),
        Column("at its end", "%", "{:.0f}"),
        Column("at the end", "%", "{:.0f}"),
    )
    table = Table("Probabilities", columns, rows, "Means over the seeds.")
    return Section("sampling", TITLE, TEXT, [table], [_figure(results, skills)])


def _ends(values: dict) -> tuple[float, float]:
    """Return the first and last iteration of all seeds: one that still trains ends the curves."""
    curves = [next(iter(curve.values())) for curve in values["curves"]]
    return max(c[0][0] for c in curves), min(c[-1][0] for c in curves)


def _seeds(values: dict, skill: str, iterations: np.ndarray) -> np.ndarray:
    """Return the probabilities of a skill at iterations (n,), (seeds, n)."""
    curves = [np.array(curve[skill]).T for curve in values["curves"]]
    return np.stack([np.interp(iterations, x, y) for x, y in curves])


def _shares(values: dict, skill: str) -> list[float | None]:
    """Return the mean probabilities at the times of the table, %; None where it has not been."""
    begin, end = _ends(values)
    at = [share * values["first_phase"] for share in (0.25, 0.75, 1.0)] + [end]
    means = 100 * _seeds(values, skill, np.array(at)).mean(axis=0)
    return [m if begin <= t <= end else None for m, t in zip(means.tolist(), at, strict=True)]


def _figure(results: dict[str, dict], skills: list[str]) -> Figure:
    drawing, axes = panels(len(results), width=4.4, height=3.0)
    for axis, (label, values) in zip(axes, results.items(), strict=True):
        begin, end = _ends(values)
        grid = np.linspace(begin, end, POINTS)
        for skill, colour in zip(skills, colours(), strict=False):
            seeds = _seeds(values, skill, grid)
            low, high = seeds.min(axis=0), seeds.max(axis=0)
            axis.fill_between(grid, low, high, color=colour, alpha=0.2, linewidth=0)
            axis.plot(grid, seeds.mean(axis=0), color=colour, linewidth=1.2, label=skill)
        axis.axhline(1 / len(skills), color="k", linestyle=":", linewidth=0.8)
        change = min(values["first_phase"], end)
        for span, colour in (((0, change), "#1f5fa8"), ((change, end), "#d1662a")):
            if span[1] > span[0]:
                axis.axvspan(*span, color=colour, alpha=0.06, linewidth=0)
        axis.set(title=label, xlabel="iteration")
    axes[0].set_ylabel("probability")
    axes[-1].legend(fontsize=7)
    note = (
        "Mean and range of the seeds; dotted: uniform; shaded: skill learning (blue), terrain "
        "finetuning (orange)."
    )
    return Figure("Probabilities", drawing, note)
