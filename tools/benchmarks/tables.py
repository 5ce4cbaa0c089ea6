"""Tables and pictures that all parts of a benchmark share."""

from __future__ import annotations

from pathlib import Path

import matplotlib
from matplotlib.figure import Figure
from rich.table import Table

_STYLE = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}


def make_table(title: str, *columns: str) -> Table:
    """Return a table whose first column has no heading."""
    table = Table(title=title, title_justify="left", caption_justify="left")
    table.add_column("", no_wrap=True)
    for column in columns:
        table.add_column(column, justify="right")
    return table


def with_range(summary: dict[str, float]) -> tuple[str, str]:
    """Return median and range of what `timing.summarise` returned."""
    return f"{summary['median']:.2f}", f"{summary['min']:.2f} to {summary['max']:.2f}"


def verdict(is_met: bool, target: str) -> str:
    """Return a line under a table: whether its target is met."""
    return f"[green]{target}: met[/]" if is_met else f"[red]{target}: missed[/]"


def save_figure(figure: Figure, path: Path) -> None:
    """Write a picture."""
    with matplotlib.rc_context(_STYLE):
        figure.savefig(path, dpi=130)
