"""Tables in a terminal."""

from __future__ import annotations

from rich.markup import escape
from rich.table import Table as RichTable

from kiras_rl.tools.report.content import Table


def as_rich(table: Table) -> RichTable:
    """Return a table for rich's console; best numbers are green."""
    shown = RichTable(title=table.title, title_justify="left", caption=table.note or None)
    for i, column in enumerate(table.columns):
        heading = escape(f"{column.name}\n{column.unit}".rstrip())
        side = "left" if table.is_words(i) else "right"
        # Narrow terminals cut words otherwise: pitch_up and pitch_down would look the same
        shown.add_column(heading, justify=side, overflow="fold", no_wrap=i == 0)
    best = [table.best_rows(i) for i in range(len(table.columns))]
    for line, row in enumerate(table.rows):
        shown.add_row(
            *(
                f"[green]{escape(column.text(cell))}[/]"
                if line in best[i]
                else escape(column.text(cell))
                for i, (column, cell) in enumerate(zip(table.columns, row, strict=True))
            )
        )
    return shown
