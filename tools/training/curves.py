"""Learning curves of a run as one picture, read back from its TensorBoard log."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Series = dict[str, tuple[list[int], list[float]]]
"""Tag -> iterations and values."""

BY_SKILL = (
    ("height, deterministic [m]", "Eval_{}/height"),
    ("pitch, deterministic [rad]", "Eval_{}/pitch"),
    ("v_x at 0.3 m/s, deterministic [m/s]", "Eval_{}/velocity"),
    ("foot lifts a second, deterministic", "Eval_{}/lifts"),
    ("error of height on flat ground [m]", "Eval_{}/height_error"),
    ("error of pitch on flat ground [rad]", "Eval_{}/pitch_error"),
    ("imitation reward", "Imitation/reward_{}"),
    ("skill probability", "Skill/probability_{}"),
)
BY_TAG = (
    ("discriminator", ("Discriminator/expert", "Discriminator/policy")),
    ("rewards a step", ("Critic/task_reward", "Critic/imitation_reward")),
)
"""Panels of every run: one line a skill, or one a tag."""

TERRAIN_BY_SKILL = (
    ("mean frontier of a skill", "Terrain/level_{}"),
    ("success on feet only, of a skill, deterministic", "Eval_{}/terrain_feet_only"),
)
TERRAIN_BY_TYPE = (
    ("mean frontier on a terrain", "Terrain/level_{}"),
    ("success on feet only, on a terrain, deterministic", "Eval_terrain/feet_only_{}"),
)
"""Panels of a run with terrain."""

COLUMNS = 4


def draw_curves(run_dir: Path) -> Path:
    """Write run_dir/curves.png and return its path.

    The ground of finetuning is shaded, so that what it forgets stands out.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    series = read_scalars(run_dir)
    skills = _names(series, "Eval_", "/height")
    types = _names(series, "Eval_terrain/feet_only_", "")
    panels = [(title, [(pattern.format(s), s) for s in skills]) for title, pattern in BY_SKILL]
    panels += [(title, [(tag, tag.split("/")[1]) for tag in tags]) for title, tags in BY_TAG]
    if types:
        for title, pattern in TERRAIN_BY_SKILL:
            panels.append((title, [(pattern.format(s), s) for s in skills]))
        for title, pattern in TERRAIN_BY_TYPE:
            panels.append((title, [(pattern.format(t), t) for t in types]))
        levels = _names(series, "Terrain/success_level_", "")
        lines = [(f"Terrain/success_level_{k}", f"level {k}") for k in levels]
        panels.append(("share of trials that succeed in training, by level", lines))
        panels.append(("distance to the flat policy", [("Residual/distance", "action")]))
    rows = -(-len(panels) // COLUMNS)
    figure, axes = plt.subplots(rows, COLUMNS, figsize=(18, 3.75 * rows), layout="constrained")
    start = series["Residual/distance"][0][0] - 1 if "Residual/distance" in series else None
    for axis in axes.flat[len(panels) :]:
        axis.remove()
    for axis, (title, lines) in zip(axes.flat, panels, strict=False):
        _draw(axis, title, series, lines, start)
    path = run_dir / "curves.png"
    figure.savefig(path, dpi=80)
    plt.close(figure)
    return path


def _draw(
    axis: Axes, title: str, series: Series, lines: Iterable[tuple[str, str]], start: int | None
) -> None:
    """Draw lines of (tag, label); from iteration `start` on the ground is shaded."""
    axis.set_title(title)
    for tag, label in lines:
        if tag in series:
            axis.plot(*series[tag], label=label, linewidth=1.2)
    axis.set_xlabel("iteration")
    axis.grid(alpha=0.3)
    if axis.lines:
        axis.legend(fontsize=8)
        if start is not None:
            left, right = axis.get_xlim()
            axis.axvspan(max(start, left), right, color="0.93", zorder=0)
            axis.set_xlim(left, right)


def _names(series: Series, before: str, after: str) -> list[str]:
    """Return what stands between `before` and `after` in the tags, in their order."""
    tags = [tag for tag in series if tag.startswith(before) and tag.endswith(after)]
    return [tag[len(before) : len(tag) - len(after)] for tag in tags]


def read_scalars(run_dir: Path) -> Series:
    """Return tag -> (iterations, values) of a run's log."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log = EventAccumulator(str(run_dir), size_guidance={"scalars": 0})
    log.Reload()
    series = {}
    for tag in log.Tags()["scalars"]:
        events = sorted(log.Scalars(tag), key=lambda event: event.step)  # files come in any order
        series[tag] = [e.step for e in events], [e.value for e in events]
    return series
