"""A trace as one picture: posture, speed, contacts and torques over time."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib import ticker
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from kiras_rl.deploy.policy import PolicyMetadata
from kiras_rl.tools.driving.script import Trace
from kiras_rl.tools.shared.outputs import save_figure

if TYPE_CHECKING:
    from matplotlib.typing import RcKeyType

WRITER = "kiras-play --trace"
_STYLE: dict[RcKeyType, Any] = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
}
_MEASURED = "#1f4e79"
_TARGET = "#d1570a"
_FALL = "#c00000"
_TINTS = ("#e3eef8", "#fdeadb", "#e6f3e1", "#efe6f5", "#fdf5d3", "#e0f3f1", "#f8e4ec", "#ededed")
_JOINT_COLORS = ("#1f4e79", "#3d9970", "#b8860b", "#8e5ea2")


def save_trace_figure(trace: Trace, metadata: PolicyMetadata, path: Path) -> None:
    """Draw a trace into a picture file; the ending of the path decides the format.

    Raises:
        ValueError: If matplotlib does not write that format; the message lists those it does.
    """
    with matplotlib.rc_context(_STYLE):
        figure = trace_figure(trace, metadata)
        save_figure(figure, path, WRITER, dpi=130)


def trace_figure(trace: Trace, metadata: PolicyMetadata) -> Figure:
    """Return the figure: five panels over one time axis."""
    panels: tuple[tuple[Callable[[Axes, Trace, PolicyMetadata], None], float], ...] = (
        (_draw_height, 1.3),
        (_draw_pitch, 1.0),
        (_draw_speed, 1.3),
        (_draw_contacts, 0.9),
        (_draw_torques, 1.4),
    )
    width = float(np.clip(3 + 0.4 * trace.time[-1], 8, 18))
    figure = Figure(figsize=(width, 8.6), layout="constrained")
    ratios = [ratio for _, ratio in panels]
    axes = figure.subplots(len(panels), 1, sharex=True, height_ratios=ratios)
    for axis, (draw, _) in zip(axes, panels, strict=True):
        draw(axis, trace, metadata)
        _shade_skills(axis, trace)
        _mark_falls(axis, trace)
    _name_skills(axes[0], trace)
    axes[-1].set_xlabel("time (s)")
    axes[-1].xaxis.set_major_locator(ticker.MaxNLocator(12, integer=True, min_n_ticks=1))
    axes[-1].set_xlim(trace.time[0] - 1 / trace.rate, trace.time[-1])
    figure.align_ylabels(axes)
    figure.suptitle(_title(trace), x=0.01, ha="left", fontsize=11)
    return figure


def _title(trace: Trace) -> str:
    falls = int(trace.fallen.sum())
    return f"{trace.title}, " + (
        f"{falls} fall{'s' if falls > 1 else ''} (red lines)" if falls else "no falls"
    )


def _draw_height(axis: Axes, trace: Trace, metadata: PolicyMetadata) -> None:
    targets = [metadata.keyframes[name].base_height for name in metadata.skills]
    _draw_against(axis, trace, 100 * trace.base_height, 100 * np.array(targets)[trace.skill])
    axis.set_ylabel("base height (cm)")
    _at_least(axis, 0, 125 * max(targets))
    axis.legend(["measured", "target"], loc="lower right", ncols=2, frameon=False)


def _draw_pitch(axis: Axes, trace: Trace, metadata: PolicyMetadata) -> None:
    targets = np.rad2deg([metadata.keyframes[name].pitch for name in metadata.skills])
    _draw_against(axis, trace, np.rad2deg(trace.pitch), targets[trace.skill])
    axis.set_ylabel("pitch (°)\nnose down +")
    _at_least(axis, targets.min() - 10, targets.max() + 10)


def _draw_speed(axis: Axes, trace: Trace, metadata: PolicyMetadata) -> None:
    _draw_against(axis, trace, trace.lin_vel[:, 0], trace.command[:, 0])
    axis.set_ylabel("$v_x$ (m/s)")
    _at_least(axis, trace.command[:, 0].min() - 0.3, trace.command[:, 0].max() + 0.3)


def _draw_contacts(axis: Axes, trace: Trace, metadata: PolicyMetadata) -> None:
    for row in range(len(trace.feet)):
        spans = [
            (_start(trace, first), (last - first) / trace.rate)
            for first, last in _runs(trace.foot_contact[:, row])
        ]
        axis.broken_barh(spans, (row - 0.36, 0.72), color=_MEASURED, linewidth=0)
    axis.set_yticks(range(len(trace.feet)), [name.split("_")[0] for name in trace.feet])
    axis.set_ylim(len(trace.feet) - 0.5, -0.5)
    axis.tick_params(axis="y", length=0)
    axis.set_ylabel("feet on\nthe ground")


def _draw_torques(axis: Axes, trace: Trace, metadata: PolicyMetadata) -> None:
    kinds = [_joint_kind(name) for name in metadata.joint_names]
    names = list(dict.fromkeys(kinds))
    for joint, kind in enumerate(kinds):
        color = _JOINT_COLORS[names.index(kind) % len(_JOINT_COLORS)]
        label = kind if kinds.index(kind) == joint else None
        torque = trace.joint_torque[:, joint]
        axis.plot(trace.time, torque, color=color, linewidth=0.6, alpha=0.8, label=label)
    for limit in sorted(set(metadata.torque_limit)):
        for sign in (-1, 1):
            axis.axhline(sign * limit, color=_TARGET, linewidth=1, linestyle=(0, (4, 2)))
    axis.set_ylabel("joint torque (N m)")
    highest = max(metadata.torque_limit)
    axis.set_ylim(-1.5 * highest, 1.15 * highest)  # below the limit: room for the legend
    axis.plot([], [], color=_TARGET, linewidth=1, linestyle=(0, (4, 2)), label="limit")
    axis.legend(loc="lower right", ncols=len(names) + 1, frameon=False)


def _draw_against(axis: Axes, trace: Trace, measured: np.ndarray, target: np.ndarray) -> None:
    axis.plot(trace.time, measured, color=_MEASURED, linewidth=1.1, zorder=3)
    breaks = np.flatnonzero(np.diff(target)) + 1  # separate pieces: a jump is no ramp
    time, target = np.insert(trace.time, breaks, np.nan), np.insert(target, breaks, np.nan)
    axis.plot(time, target, color=_TARGET, linewidth=1.6, linestyle=(0, (4, 2)), zorder=4)
    axis.yaxis.set_major_locator(ticker.MaxNLocator(5))


def _at_least(axis: Axes, low: float, high: float) -> None:
    bottom, top = axis.get_ylim()
    axis.set_ylim(min(bottom, low), max(top, high))


def _shade_skills(axis: Axes, trace: Trace) -> None:
    for first, last in _spans(trace):
        tint = _TINTS[trace.skill[first] % len(_TINTS)]
        axis.axvspan(_start(trace, first), trace.time[last - 1], color=tint, linewidth=0, zorder=0)
    axis.grid(axis="x", color="white", linewidth=0.8)
    axis.set_axisbelow(True)


def _name_skills(axis: Axes, trace: Trace) -> None:
    for first, last in _spans(trace):
        middle = (_start(trace, first) + trace.time[last - 1]) / 2
        axis.text(
            middle,
            1.02,
            trace.skills[trace.skill[first]].replace("_", " "),
            transform=axis.get_xaxis_transform(),
            ha="center",
            va="bottom",
            fontweight="bold",
        )


def _mark_falls(axis: Axes, trace: Trace) -> None:
    for time in trace.time[trace.fallen]:
        axis.axvline(time, color=_FALL, linewidth=0.9, zorder=2)


def _spans(trace: Trace) -> Iterator[tuple[int, int]]:
    """Yield first and one-past-last sample of every stretch of one skill."""
    edges = np.flatnonzero(np.diff(trace.skill)) + 1
    bounds = [0, *edges.tolist(), len(trace.skill)]
    yield from itertools.pairwise(bounds)


def _runs(flags: np.ndarray) -> Iterator[tuple[int, int]]:
    """Yield first and one-past-last index of every run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)


def _start(trace: Trace, index: int) -> float:
    """Return when the step of a sample began; its `time` is when it ended."""
    return float(trace.time[index] - 1 / trace.rate)


def _joint_kind(name: str) -> str:
    """Return a joint's name without its leg and its filler words: FL_hip_joint -> hip."""
    parts = name.removesuffix("_joint").split("_")
    return "_".join(parts[1:]) or name
