"""Numbers from a trace: how well each skill follows its posture and its command."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rich import box
from rich.table import Table

from kiras_rl.deploy.policy import PolicyMetadata
from kiras_rl.tools.driving.script import Trace

SETTLE = 1.0  # s after a change of task that do not count: the robot is on its way
_COLUMNS = (
    "height\nerror cm",
    "pitch\nerror °",
    "v_x\nm/s",
    "command\nm/s",
    "v_x error\nm/s",
    "lifts\n1/s",
    "falls",
)
AVERAGE = 0.4  # s over which height and pitch are averaged: about two strides


@dataclass(frozen=True)
class SkillSummary:
    """Mean absolute errors of one skill, once settled, as in `kiras_rl.evaluation.flat`; SI."""

    skill: str
    height_error: float
    """Of the moving average."""
    pitch_error: float
    """Of the moving average."""
    velocity: float
    """Mean v_x, m/s."""
    command: float
    """Mean commanded v_x, m/s."""
    velocity_error: float
    """Of v_x, m/s."""
    lifts: float
    """Lifts a second of the foot that lifts least."""
    falls: int
    crossings: int | None
    """Ends of the tile that it came to; None on flat ground."""


def summarize(trace: Trace, metadata: PolicyMetadata) -> list[SkillSummary]:
    """Return one summary for each skill of the trace, in the order of the policy's skills."""
    return [_summarize(trace, metadata, skill) for skill in np.unique(trace.skill)]


def table(summaries: list[SkillSummary], title: str) -> Table:
    """Lay summaries out for a terminal."""
    result = Table(title=title, title_justify="left", box=box.SIMPLE, padding=(0, 1, 0, 0))
    result.add_column("skill", no_wrap=True)
    for name in _COLUMNS:
        result.add_column(name, justify="right")
    rough = any(item.crossings is not None for item in summaries)
    if rough:
        result.add_column("crossed", justify="right")
    for item in summaries:
        result.add_row(
            item.skill,
            f"{100 * item.height_error:.1f}",
            f"{np.rad2deg(item.pitch_error):.1f}",
            f"{round(item.velocity, 2) + 0.0:.2f}",  # no minus zero
            f"{item.command:.2f}",
            f"{item.velocity_error:.2f}",
            f"{item.lifts:.1f}",
            str(item.falls),
            *([str(item.crossings)] if rough else []),
            style="red" if item.falls else None,
        )
    return result


def _summarize(trace: Trace, metadata: PolicyMetadata, skill: int) -> SkillSummary:
    name = metadata.skills[skill]
    posture = metadata.keyframes[name]
    mine = trace.skill == skill
    settled = mine & (seconds_in_segment(trace) >= SETTLE)
    rows = settled if settled.any() else mine
    speed, command = trace.lin_vel[rows, 0], trace.command[rows, 0]
    height = moving_average(trace.base_height, trace.rate)[rows]
    pitch = moving_average(trace.pitch, trace.rate)[rows]
    return SkillSummary(
        skill=name,
        height_error=float(np.abs(height - posture.base_height).mean()),
        pitch_error=float(np.abs(pitch - posture.pitch).mean()),
        velocity=float(speed.mean()),
        command=float(command.mean()),
        velocity_error=float(np.abs(speed - command).mean()),
        lifts=float(lifts_per_second(trace.foot_contact, rows, trace.rate).min()),
        falls=int(trace.fallen[mine].sum()),
        crossings=None if trace.is_flat else int(trace.crossed[mine].sum()),
    )


def seconds_in_segment(trace: Trace) -> np.ndarray:
    """Return the time since the task of each sample was set, (T,), s."""
    starts = np.searchsorted(trace.segment, trace.segment)  # segments are numbered upwards
    return (np.arange(len(trace.segment)) - starts) / trace.rate


def moving_average(signal: np.ndarray, rate: float) -> np.ndarray:
    """Average each sample of (T,) with those of the time before it."""
    width = round(AVERAGE * rate)
    padded = np.concatenate([np.repeat(signal[:1], width - 1), signal])
    return np.convolve(padded, np.full(width, 1 / width), mode="valid")


def lifts_per_second(contact: np.ndarray, rows: np.ndarray, rate: float) -> np.ndarray:
    """Count how often each foot leaves the ground.

    Args:
        contact: Feet on the ground, (T, F) bool.
        rows: Samples that count, (T,) bool.
        rate: Samples a second.

    Returns:
        Lifts a second, (F,).
    """
    lifts = contact[:-1] & ~contact[1:] & (rows[:-1] & rows[1:])[:, None]
    return lifts.sum(axis=0) * rate / rows.sum()
