"""The paper's heat map: cosine (C), steps (S) and discrete footholds (D) of each skill."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import cache, partial

import numpy as np

from kiras_rl.envs.quadruped import QuadrupedEnv
from kiras_rl.evaluation.flat import FLOOR
from kiras_rl.evaluation.terrain import TIME_LIMIT, Obstacle
from kiras_rl.tools.evaluation.protocols import imitation
from kiras_rl.tools.evaluation.protocols.crossing import (
    KINDS,
    count,
    percent,
    pooled,
    share,
    shares,
)
from kiras_rl.tools.evaluation.protocols.pooling import pool
from kiras_rl.tools.evaluation.protocols.rows import panels
from kiras_rl.tools.evaluation.protocols.subject import Subject
from kiras_rl.tools.evaluation.report.content import Column, Figure, Section, Table

TITLE = "Heat map: steps and discrete footholds"
TEXT = (
    "As the protocol terrain, on steps up and down (S) and discrete footholds (D) of given sizes, "
    "with many trials, and the cosine to the keyframe on flat ground (C) beside them. Sizes are in "
    "cm, times the scale of the robot's terrain. Kept: crossed in the skill's own keyframe, with "
    "mean errors of height and pitch over the ground it stands on of at most "
    f"{100 * FLOOR.height:.0f} cm and {math.degrees(FLOOR.pitch):.0f} degrees."
)

SMALLEST, LARGEST = 2, 12  # cm: of a level each
SIZES = {
    "stairs_up": "riser",
    "stairs_down": "riser",
    "bars": "height",
    "footholds": "gap",
}
"""What is measured of each type."""

HEADLINE = {"S up": ("stairs_up", 6), "S down": ("stairs_down", 6), "D": ("footholds", 8)}
OTHERS = (
    *((name, size) for name in ("stairs_up", "stairs_down") for size in (4, 8, 10, 12)),
    ("bars", 6),
    *(("footholds", size) for size in (4, 6, 10)),
)
"""Type and size, cm."""

HEADLINE_TRIALS, OTHER_TRIALS = 1000, 200  # of each skill [paper: 1,000]
CHUNK = 200  # trials of a skill at a time: an interruption loses no more


def measure(subject: Subject) -> dict:
    """Return the counts of each obstacle and skill, and the cosines."""
    build, trials = cache(partial(_build, subject)), subject.options.trials_or
    wanted = dict.fromkeys(HEADLINE.values(), trials(HEADLINE_TRIALS))
    wanted |= dict.fromkeys(OTHERS, trials(OTHER_TRIALS))
    parts = {o: dict(_parts(subject, build, *o, number)) for o, number in wanted.items()}
    pieces = {key: run for runs in parts.values() for key, run in runs.items()}
    on_flat, run = imitation.piece(subject)
    results = subject.results(pieces | {on_flat: run})
    cells = {obstacle: pool([results[key] for key in keys]) for obstacle, keys in parts.items()}
    return {
        "scale": subject.terrain.scale,
        "headline": {name: cells[obstacle] for name, obstacle in HEADLINE.items()},
        "others": [{"type": o[0], "size": o[1], "cells": cells[o]} for o in OTHERS],
        "cosine": {name: values["cosine"] for name, values in results[on_flat]["skills"].items()},
    }


def _build(subject: Subject, trials: int) -> QuadrupedEnv:
    """Build the terrain of a policy with a level for each size, for `trials` of each skill."""
    config, ground = subject.rough(), subject.terrain
    ground.levels = LARGEST - SMALLEST + 1
    own, ends = ground.types, [SMALLEST / 100, LARGEST / 100]
    ground.types = {name: own[name] | {key: ends} for name, key in SIZES.items()}
    config.env.terrain = ground
    return subject.make_env(config, trials * len(subject.skills), TIME_LIMIT)


def _parts(
    subject: Subject, build: Callable[[int], QuadrupedEnv], terrain: str, size: int, trials: int
) -> Iterator[tuple[str, Callable[[], dict]]]:
    """Yield the key of each CHUNK of trials, and what measures it."""
    obstacle = Obstacle(terrain, size - SMALLEST)

    def run(number: int, index: int) -> dict:
        return count(build(number), subject, [obstacle], number, index)[0]

    for index, done in enumerate(range(0, trials, CHUNK)):
        number = min(CHUNK, trials - done)
        key = subject.key(
            "heat_map",
            type=terrain,
            cm=size,
            part=index,
            trials=number,
            kept=f"{100 * FLOOR.height:g}cm,{math.degrees(FLOOR.pitch):g}deg",
        )
        yield key, partial(run, number, index)


def section(results: dict[str, dict]) -> Section:
    """Return the heat maps, the shares with their intervals, and the other levels."""
    tables = [_headline(name, results) for name in HEADLINE]
    tables += [_others(label, values) for label, values in results.items()]
    figures = [_figure(kind, results) for kind in (*KINDS, "kept")]
    return Section("heat_map", TITLE, TEXT, tables, figures)


def _size(values: dict, terrain: str, size: int) -> str:
    word = {"stairs_up": "steps up", "stairs_down": "steps down", "footholds": "gaps"}
    return f"{word.get(terrain, terrain)} of {values['scale'] * size:g} cm"


def _headline(name: str, results: dict[str, dict]) -> Table:
    first = next(iter(results.values()))
    rows = [
        (
            skill,
            label,
            *(percent(counts, kind) for kind in (*KINDS, "kept")),
            100 * share(counts, "fell"),
            counts["trials"],
        )
        for label, values in results.items()
        for skill, counts in _with_all(values["headline"][name]).items()
    ]
    columns = (
        Column("skill"),
        Column("policy"),
        Column("success", "%"),
        Column("feet only", "%"),
        Column("strict", "%"),
        Column("kept", "%"),
        Column("falls", "%", "{:.0f}"),
        Column("trials", form="{}"),
    )
    title = f"{name}: {_size(first, *HEADLINE[name])}"
    return Table(title, columns, rows, "In brackets Wilson's 95 % intervals.")


def _with_all(cells: dict[str, dict]) -> dict[str, dict]:
    return cells | {"all": pooled(cells)}


def _others(label: str, values: dict) -> Table:
    rows, skills = [], list(next(iter(values["headline"].values())))
    for cell in values["others"]:
        texts = [
            f"{shares(c)} / {100 * share(c, 'kept'):.0f}" for c in _with_all(cell["cells"]).values()
        ]
        rows.append((_size(values, cell["type"], cell["size"]), *texts))
    columns = (Column("obstacle"), *map(Column, skills), Column("all"))
    return Table(
        f"Other sizes: {label}", columns, rows, "Success / on feet only / strict / kept, in %."
    )


def _figure(kind: str, results: dict[str, dict]) -> Figure:
    drawing, axes = panels(1 + len(HEADLINE), width=1.2 + 0.9 * len(results), height=3.0)
    skills = list(next(iter(results.values()))["cosine"])
    for axis, name in zip(axes, ("C", *HEADLINE), strict=True):
        cells = np.array(
            [
                [
                    values["cosine"][skill]
                    if name == "C"
                    else share(values["headline"][name][skill], kind)
                    for values in results.values()
                ]
                for skill in skills
            ],
            dtype=float,
        )
        axis.imshow(cells, vmin=0.0, vmax=1.0, cmap="Blues", aspect="auto")
        axis.grid(False)
        for (row, column), value in np.ndenumerate(cells):
            ink = "white" if value > 0.6 else "black"
            axis.text(column, row, f"{value:.2f}", ha="center", va="center", color=ink, fontsize=8)
        axis.set_title(name)
        axis.set_yticks(range(len(skills)), skills)
        axis.set_xticks(range(len(results)), list(results), rotation=30, ha="right", fontsize=7)
    return Figure(f"Heat map: {kind}", drawing, "C: cosine; S: steps; D: discrete footholds.")
