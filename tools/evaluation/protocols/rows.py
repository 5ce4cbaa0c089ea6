"""What the tables of all protocols have in common."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing

from kiras_rl.tools.evaluation.report.content import Cell, Column, Table

ABREAST = 7  # panels in a row
PALETTE = ("#1f5fa8", "#d1662a", "#2f8f57", "#8a4fb0", "#b3364a", "#6b7280", "#0f8b8d", "#a67c00")


def skill_table(
    title: str,
    columns: tuple[Column, ...],
    results: dict[str, dict[str, dict]],
    cells: Callable[[dict], tuple[Cell, ...]],
    note: str = "",
) -> Table:
    """Return a table with a row for each skill of each policy.

    Args:
        title: Of the table.
        columns: Behind the skill and, if there are several policies, their label.
        results: Label -> skill -> values.
        cells: Values -> cells of `columns`.
        note: How to read it.
    """
    several = len(results) > 1
    skills = list(dict.fromkeys(skill for values in results.values() for skill in values))
    rows = [
        (*((skill, label) if several else (skill,)), *cells(values[skill]))
        for skill in skills
        for label, values in results.items()
        if skill in values
    ]
    names = ("skill", "policy") if several else ("skill",)
    return Table(title, (*map(Column, names), *columns), rows, note)


def scaled(value: float | None, factor: float) -> float | None:
    """Return value * factor; None stays None."""
    return None if value is None else value * factor


def panels(
    count: int, width: float = 3.4, height: float = 2.8, share: bool = True
) -> tuple[Drawing, list[Axes]]:
    """Return a drawing with `count` axes in rows of ABREAST, which share y axes if asked to."""
    columns = min(count, ABREAST)
    rows = -(-count // ABREAST)
    drawing = Drawing(figsize=(width * columns, height * rows), layout="constrained")
    axes = drawing.subplots(rows, columns, sharey=share, squeeze=False).ravel()
    for axis in axes[count:]:
        axis.remove()
    for axis in axes[:count]:
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    return drawing, list(axes[:count])


def colours() -> Iterator[str]:
    """Yield one colour after the other, round and round."""
    while True:
        yield from PALETTE
