"""How all parts of a benchmark show their figures."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rich.table import Table

if TYPE_CHECKING:
    from matplotlib.typing import RcKeyType

STYLE: dict[RcKeyType, Any] = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "savefig.dpi": 130,
}
"""Settings of matplotlib for the pictures."""


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
