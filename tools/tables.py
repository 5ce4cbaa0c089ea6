"""Tables of what the evaluation protocols found, for a terminal."""

from __future__ import annotations

import math
from itertools import zip_longest

import torch
from rich.table import Table

from kiras_rl.evaluation.flat import SkillResult
from kiras_rl.evaluation.imitation import STEPS, Imitation
from kiras_rl.evaluation.terrain import TerrainResult
from kiras_rl.evaluation.transitions import Transitions
from kiras_rl.tools.evaluator import FLOOR


def results_table(results: dict[str, SkillResult], title: str) -> Table:
    """Return a table with one row a skill; green rows reach FLOOR."""
    columns = ("skill", "height", "error", "pitch", "error", "v_x", "error", "lifts", "falls")
    units = ("", "cm", "cm", "deg", "deg", "m/s", "m/s", "1/s", "%")
    table = Table(title=title, title_justify="left")
    for column, unit in zip(columns, units, strict=True):
        table.add_column(f"{column}\n{unit}", justify="right" if unit else "left")
    for skill, r in results.items():
        row = (
            f"{100 * r.height:.1f}",
            f"{100 * r.height_error:.1f}",
            f"{math.degrees(r.pitch):+.1f}",
            f"{math.degrees(r.pitch_error):.1f}",
            f"{r.velocity:+.2f}",
            f"{r.velocity_error:.2f}",
            f"{r.lifts:.1f}",
            f"{100 * r.falls:.0f}",
        )
        table.add_row(skill, *row, style="green" if r.meets(**FLOOR) else "yellow")
    return table


def terrain_table(result: TerrainResult) -> Table:
    """Return a table of the shares of success: terrain types by skills."""
    title = f"terrain, level {result.level}: success %, in brackets without knees"
    table = Table(title=title, title_justify="left")
    table.add_column("terrain")
    for skill in result.skills:
        table.add_column(skill, justify="right")
    for name, success, strict in zip(
        result.terrains, result.success.tolist(), result.strict.tolist(), strict=True
    ):
        cells = [f"{100 * a:.0f} ({100 * b:.0f})" for a, b in zip(success, strict, strict=True)]
        table.add_row(name, *cells)
    return table


def transitions_table(result: Transitions, skills: tuple[str, ...]) -> Table:
    """Return a table of every ordered pair of skills."""
    title = f"transitions: settled %, mean settle time s, falls % ({result.trials} trials a pair)"
    table = Table(title=title, title_justify="left")
    table.add_column("from / to")
    for skill in skills:
        table.add_column(skill, justify="right")
    for i, first in enumerate(skills):
        cells = [
            ""
            if i == j
            else _transition(result.settled[i, j], result.settle_time[i, j], result.fell[i, j])
            for j in range(len(skills))
        ]
        table.add_row(first, *cells)
    return table


def _transition(settled: torch.Tensor, time: torch.Tensor, fell: torch.Tensor) -> str:
    falls = f" [red]{100 * fell:.0f}[/]" if fell > 0 else ""
    return f"{100 * settled:.0f} {time:.2f}{falls}"


def imitation_tables(result: Imitation, robots: int) -> list[Table]:
    """Return tables of posture, gait and nearest keyframes, one row a skill."""
    posture = _table(
        f"imitation: {robots} robots a skill, {STEPS} steps",
        ("DTW", "a frame", "cosine", "centred", "height error", "pitch error", "falls"),
        ("mean ± std", "", "", "", "cm", "deg", "%"),
    )
    gait = _table(
        "gait",
        ("v_x", "clearance", "frequency", "duty", "torque", "peak", "power", "transport"),
        ("m/s", "cm", "1/s", "%", "N m", "N m", "W", ""),
    )
    for skill, r in result.skills.items():
        posture.add_row(
            skill,
            f"{r.dtw:.1f} ± {r.dtw_std:.1f}",
            f"{r.dtw_frame:.3f}",
            f"{r.cosine:.3f}",
            f"{r.centred_cosine:.3f}",
            f"{100 * r.height_error:.1f}",
            f"{math.degrees(r.pitch_error):.1f}",
            f"{100 * r.falls:.0f}",
        )
        gait.add_row(
            skill,
            f"{r.velocity:+.2f}",
            f"{100 * r.clearance:.1f}",
            f"{r.frequency:.1f}",
            f"{100 * r.duty:.0f}",
            f"{r.torque:.2f}",
            f"{r.peak_torque:.2f}",
            f"{r.power:.1f}",
            f"{r.cost_of_transport:.2f}",
        )
    nearest = _table("nearest keyframe, % of the steps", tuple(result.skills))
    for skill, shares in zip(result.skills, result.confusion.tolist(), strict=True):
        nearest.add_row(skill, *(f"{100 * share:.0f}" for share in shares))
    return [posture, gait, nearest]


def _table(title: str, columns: tuple[str, ...], units: tuple[str, ...] = ()) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column("skill")
    for column, unit in zip_longest(columns, units, fillvalue=""):
        table.add_column(f"{column}\n{unit}" if units else column, justify="right")
    return table
