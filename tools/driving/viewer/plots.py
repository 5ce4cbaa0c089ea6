"""Line plots for the page, drawn straight into an ImGui window: cheap, and all in one look."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from mujoco.studio.dear_imgui import dear_imgui as imgui

MEASURED = (0.35, 0.78, 1.00, 1.0)
TARGET = (1.00, 0.72, 0.30, 1.0)
ESTIMATE = (0.62, 0.90, 0.45, 1.0)
_GRID = (1.0, 1.0, 1.0, 0.09)
_FRAME = (0.0, 0.0, 0.0, 0.28)
_FAINT = (0.72, 0.77, 0.83, 1.0)
_MARGIN = 34.0  # pixels for the numbers on the left
_POINTS = 160  # a line; more than the plot's pixels would be lost


@dataclass(frozen=True)
class Line:
    """One line of a plot: its name in the legend, its colour, its numbers (T,); NaN is a gap."""

    name: str
    colour: tuple[float, float, float, float]
    values: np.ndarray


def draw_plot(
    title: str,
    time: np.ndarray,
    lines: Sequence[Line],
    levels: Sequence[float],
    size: tuple[float, float],
    seconds: float,
) -> None:
    """Draw one plot at the cursor.

    Args:
        title: Quantity and unit.
        time: Of the samples, (T,), s; the newest is at the right edge.
        lines: What to draw; a line of NaN alone is left out.
        levels: Values that are always shown, and marked with a line.
        size: Width and height with title and legend, pixels.
        seconds: Shown before the newest sample.
    """
    shown = [line for line in lines if np.isfinite(line.values).any()]
    _heading(title, shown, size[0])
    corner = imgui.GetCursorScreenPos()
    height = size[1] - 2 * imgui.GetTextLineHeightWithSpacing()
    box = (corner.x + _MARGIN, corner.y, size[0] - _MARGIN, height)
    low, high = _range(shown, levels)
    canvas = imgui.GetWindowDrawList()
    _frame(canvas, box, levels, low, high)
    if len(time):
        for line in reversed(shown):  # the first on top
            _polyline(canvas, box, line, (time - time[-1]) / seconds + 1, low, high)
    imgui.Dummy(imgui.Vec2(size[0], height))


def colour(rgba: tuple[float, float, float, float]) -> int:
    """Return a colour as ImGui packs it."""
    return imgui.ColorConvertFloat4ToU32(imgui.Vec4(*rgba))


def _heading(title: str, lines: Sequence[Line], width: float) -> None:
    """Write the title, and below it the legend with the newest numbers."""
    imgui.Text(title)
    for index, line in enumerate(lines):
        if index:
            imgui.SameLine(_MARGIN + index * (width - _MARGIN) / 3)
        else:
            imgui.SetCursorPosX(imgui.GetCursorPosX() + _MARGIN)
        finite = line.values[np.isfinite(line.values)]
        imgui.TextColored(imgui.Vec4(*line.colour), f"{line.name} {finite[-1]:.2f}")


def _range(lines: Sequence[Line], levels: Sequence[float]) -> tuple[float, float]:
    """Return the shown range of values: that of the levels, grown to what the lines need."""
    values = np.concatenate([line.values for line in lines]) if lines else np.zeros(0)
    values = values[np.isfinite(values)]
    low, high = min([*levels, *values]), max([*levels, *values])
    pad = 0.1 * (high - low)
    return low - pad, high + pad


def _frame(
    canvas: imgui.DrawList,
    box: tuple[float, float, float, float],
    levels: Sequence[float],
    low: float,
    high: float,
) -> None:
    """Draw the background, the levels and their numbers."""
    x, y, width, height = box
    canvas.AddRectFilled(imgui.Vec2(x, y), imgui.Vec2(x + width, y + height), colour(_FRAME), 4.0)
    half = 0.5 * imgui.GetTextLineHeight()
    for value in levels:
        level = y + height * (high - value) / (high - low)
        canvas.AddLine(imgui.Vec2(x, level), imgui.Vec2(x + width, level), colour(_GRID))
        number = f"{value:g}"
        left = x - 6 - imgui.CalcTextSize(number).x
        canvas.AddText(imgui.Vec2(left, level - half), colour(_FAINT), number)


def _polyline(
    canvas: imgui.DrawList,
    box: tuple[float, float, float, float],
    line: Line,
    across: np.ndarray,
    low: float,
    high: float,
) -> None:
    """Draw one line: `across` is 0 at the left edge and 1 at the right one, (T,)."""
    x, y, width, height = box
    stride = max(1, len(across) // _POINTS)
    start = (len(across) - 1) % stride  # so that the newest sample is among those drawn
    across, values = across[start::stride], line.values[start::stride]
    seen = np.isfinite(values) & (across >= 0)
    xs = x + width * across[seen]
    ys = y + height * (high - values[seen]) / (high - low)
    points = [imgui.Vec2(px, py) for px, py in zip(xs.tolist(), ys.tolist(), strict=True)]
    if len(points) > 1:
        canvas.AddPolyline(points, colour(line.colour), 1.8)
