"""With which probability each skill was practised, over the training."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from kiras_rl.config import ConfigError
from kiras_rl.tools.protocols.rows import colours, panels
from kiras_rl.tools.protocols.subject import Subject
from kiras_rl.tools.report.content import Column, Figure, Section, Table

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
    skills = [f"Skill/probability_{name}" for name in subject.skills]
    curves = _read(run, skills)
    if not all(curves.values()):
        raise ConfigError(
            f"sampling: the log of {run} holds no skill probabilities (learner.skill_init=null "
            "draws skills uniformly)"
        )
    return {
        "first_phase": subject.run.iterations,
        "curves": [{name.removeprefix("Skill/probability_"): c for name, c in curves.items()}],
    }


def run_of(source: Path) -> Path | None:
    """Return the run folder of a policy file, None where it lies in none."""
    for folder in (source.parent, source.parent.parent):
        if (folder / "config.yaml").is_file() and any(folder.glob("events.*")):
            return folder
    return None


def _read(run: Path, names: list[str]) -> dict[str, list[tuple[int, float]]]:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log = EventAccumulator(str(run), size_guidance={"scalars": 0})
    log.Reload()
    known = set(log.Tags()["scalars"])
    return {
        name: [(e.step, e.value) for e in log.Scalars(name)] if name in known else []
        for name in names
    }


def section(results: dict[str, dict]) -> Section:
    """Return the curves, and the probabilities at the ends of the phases."""
    skills = list(next(iter(results.values()))["curves"][0])
    drawing, axes = panels(len(results), width=4.4, height=3.0)
    rows = []
    for axis, (label, values) in zip(axes, results.items(), strict=True):
        last = max(curve[skills[0]][-1][0] for curve in values["curves"])
        grid = np.linspace(1, last, POINTS)
        for skill, colour in zip(skills, colours(), strict=False):
            seeds = np.stack(
                [np.interp(grid, *zip(*curve[skill], strict=True)) for curve in values["curves"]]
            )
            axis.fill_between(
                grid, seeds.min(0), seeds.max(0), color=colour, alpha=0.2, linewidth=0
            )
            axis.plot(grid, seeds.mean(0), color=colour, linewidth=1.2, label=skill)
            at = {
                share: float(np.interp(share * values["first_phase"], grid, seeds.mean(0)))
                for share in (0.25, 0.75, 1.0)
            }
            rows.append((label, skill, *(100 * x for x in at.values()), 100 * seeds.mean(0)[-1]))
        axis.axhline(1 / len(skills), color="k", linestyle=":", linewidth=0.8)
        if last > values["first_phase"]:
            axis.axvspan(values["first_phase"], last, color="#d1662a", alpha=0.08, linewidth=0)
        axis.set(title=label, xlabel="iteration")
    axes[0].set_ylabel("probability")
    axes[-1].legend(fontsize=7)
    columns = (
        Column("policy"),
        Column("skill"),
        Column("at 25 % of skill learning", "%", "{:.0f}"),
        Column("at 75 %", "%", "{:.0f}"),
        Column("at its end", "%", "{:.0f}"),
        Column("at the end", "%", "{:.0f}"),
    )
    note = "Dotted: uniform; shaded: terrain finetuning."
    table = Table("Probabilities", columns, rows)
    return Section("sampling", TITLE, TEXT, [table], [Figure("Probabilities", drawing, note)])
