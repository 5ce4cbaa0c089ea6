"""Tables in a terminal."""

from __future__ import annotations

import textwrap

from rich import box
from rich.table import Table as RichTable
from rich.text import Text

from kiras_rl.tools.evaluation.report.content import Table

HEADING_WIDTH = 10  # characters, or of the longest word


def as_rich(table: Table) -> RichTable:
    """Return a table for rich's console; best numbers are green."""
    shown = RichTable(
        title=table.title,
        title_justify="left",
        caption=table.note or None,
        box=box.SIMPLE_HEAD,  # without lines between columns ten of them fit in 80 characters
        show_edge=False,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    for i, column in enumerate(table.columns):
        lines = textwrap.wrap(column.name, HEADING_WIDTH, break_long_words=False)
        heading = Text("\n".join([*lines, column.unit]).rstrip())
        side = "left" if table.is_words(i) else "right"
        # Narrow terminals cut words otherwise: pitch_up and pitch_down would look the same
        shown.add_column(heading, justify=side, overflow="fold", no_wrap=i == 0)
    best = [table.best_rows(i) for i in range(len(table.columns))]
    for line, row in enumerate(table.rows):
        shown.add_row(
            *(
                Text(column.text(cell), style="green" if line in best[i] else "")
                for i, (column, cell) in enumerate(zip(table.columns, row, strict=True))
            )
        )
    return shown
