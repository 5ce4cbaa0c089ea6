"""Every skill on every rough terrain type at several levels of difficulty."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import torch

from kiras_rl.envs.quadruped import QuadrupedEnv
from kiras_rl.evaluation.terrain import TIME_LIMIT, Obstacle, TerrainResult, rough_types
from kiras_rl.tools.evaluation.protocols.crossing import (
    KINDS,
    KINDS_NOTE,
    count,
    pooled,
    share,
    shares,
)
from kiras_rl.tools.evaluation.protocols.rows import colours, panels
from kiras_rl.tools.evaluation.protocols.subject import Subject
from kiras_rl.tools.evaluation.report.content import Column, Figure, Section, Table

TITLE = "Terrain"
TEXT = (
    "Every skill crosses every rough terrain type at several levels of difficulty, 0 the lowest "
    "and 10 the top, bumps included: from the middle of a tile, with any heading, "
    "which is held, at 0.2 to 0.6 m/s, 3 m far within twice the time of the way and 20 s, without "
    "a fall; on feet only, if trunk, thighs and shanks take at most a tenth of the impulse that "
    "the ground gives; strictly, if thighs and shanks touch the ground in at most 5 % of the steps."
)

TRIALS = 50  # of a cell
LEVELS = 11
"""Whatever the training had: steps of a tenth from lowest to top."""


def measure(subject: Subject) -> dict:
    """Return the counts of each level, type and skill."""
    options, names = subject.options, rough_names(subject)
    trials = options.trials_or(TRIALS)

    @cache
    def build() -> QuadrupedEnv:
        return terrain_env(subject, trials * len(names))

    def level(number: int) -> dict:
        obstacles = [Obstacle(name, number) for name in names]
        return dict(zip(names, count(build(), subject, obstacles, trials), strict=True))

    keys = {n: subject.key("terrain", level=n, trials=trials) for n in options.levels}
    results = subject.results({key: partial(level, number) for number, key in keys.items()})
    return {"levels": {str(number): results[key] for number, key in keys.items()}}


def terrain_env(subject: Subject, trials: int) -> QuadrupedEnv:
    """Build the terrain of a policy with LEVELS levels, for `trials` of each skill."""
    config = subject.rough()
    config.env.terrain = replace(subject.terrain, levels=LEVELS)
    worlds = trials * len(subject.skills)
    return subject.make_env(config, worlds, TIME_LIMIT)


def rough_names(subject: Subject) -> list[str]:
    """Return the terrain types of a policy that are not flat."""
    types = subject.terrain.types
    return list(rough_types([name for name, values in types.items() if values is not None]))


def section(results: dict[str, dict]) -> Section:
    """Return a table a level and the shares over the levels."""
    levels = sorted({int(level) for v in results.values() for level in v["levels"]})
    tables = [_table(level, results) for level in levels]
    figures = [_figure(kind, levels, results) for kind in ("success", "feet_only")]
    return Section("terrain", TITLE, TEXT, tables, figures)


def _table(level: int, results: dict[str, dict]) -> Table:
    rows, skills = [], []
    for label, values in results.items():
        for terrain, cells in values["levels"].get(str(level), {}).items():
            skills = skills or list(cells)
            texts = (shares(c) for c in _with_all(cells).values())
            rows.append((terrain, label, *texts))
    columns = (
        Column("terrain"),
        Column("policy"),
        *map(Column, skills),
        Column("all"),
    )
    return Table(f"Level {level}", columns, rows, KINDS_NOTE)


def result_table(result: TerrainResult) -> Table:
    """Return the table of an evaluation beside a training."""
    by_terrain = torch.stack([getattr(result, kind) for kind in KINDS], dim=-1).tolist()
    rows = [
        (name, *(" / ".join(f"{100 * share:.0f}" for share in cell) for cell in cells))
        for name, cells in zip(result.terrains, by_terrain, strict=True)
    ]
    columns = (Column("terrain"), *map(Column, result.skills))
    return Table(f"Terrain, level {result.level}", columns, rows, KINDS_NOTE)


def _with_all(cells: dict[str, dict]) -> dict[str, dict]:
    return cells | {"all": pooled(cells)}


def _figure(kind: str, levels: list[int], results: dict[str, dict]) -> Figure:
    types = list(next(iter(next(iter(results.values()))["levels"].values())))
    drawing, axes = panels(len(types))
    for axis, terrain in zip(axes, types, strict=True):
        for (label, values), colour in zip(results.items(), colours(), strict=False):
            cells = [values["levels"].get(str(level), {}).get(terrain) for level in levels]
            known = [
                (level, 100 * share(pooled(cell), kind))
                for level, cell in zip(levels, cells, strict=True)
                if cell
            ]
            axis.plot(*zip(*known, strict=True), "o-", color=colour, label=label, markersize=3)
        axis.set(title=terrain, xlabel="level", ylim=(-3, 103))
    axes[0].set_ylabel(f"{kind} [%]")
    axes[0].legend(fontsize=7)
    title = {"success": "Success", "feet_only": "Success on feet only"}[kind] + " over the levels"
    return Figure(title, drawing, "Mean over all skills.")
