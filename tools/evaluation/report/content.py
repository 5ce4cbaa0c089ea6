"""What a report is made of: sections of tables and figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from matplotlib.figure import Figure as Drawing

Cell = str | float | int | None


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        name: Heading.
        unit: Of the numbers; empty for words and for shares.
        form: Format of the numbers where people read them, as of str.format; files hold all digits.
        best: "low" or "high" where the best number is marked, "" where none is better.
    """

    name: str
    unit: str = ""
    form: str = "{:.2f}"
    best: str = ""

    @property
    def heading(self) -> str:
        """Name and unit."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    def text(self, cell: Cell) -> str:
        """Return a cell as people read it; one without a value is a dash."""
        if cell is None or cell != cell:
            return "–"  # noqa: RUF001  (a dash, not a minus)
        return cell if isinstance(cell, str) else self.form.format(cell)


@dataclass(frozen=True)
class Table:
    """Rows of words and numbers.

    Attributes:
        title: What it shows.
        columns: Headings.
        rows: One cell a column; None where nothing was measured.
        note: How to read it.
    """

    title: str
    columns: tuple[Column, ...]
    rows: Sequence[tuple[Cell, ...]]
    note: str = ""

    def __post_init__(self) -> None:
        """Check that every row has a cell a column."""
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(
                    f"table '{self.title}': {len(row)} cells for {len(self.columns)} columns: {row}"
                )

    def best_rows(self, index: int) -> set[int]:
        """Return the rows that hold the best number of a column among those of the same first cell.

        None where all are alike: policies are compared in one skill, not skills with each other.
        """
        goal = {"low": min, "high": max, "": None}[self.columns[index].best]
        groups: dict[Cell, dict[int, float]] = {}
        for i, row in enumerate(self.rows):
            value = row[index]
            if isinstance(value, int | float) and value == value:
                groups.setdefault(row[0], {})[i] = value
        return {
            i
            for values in groups.values()
            for i, value in values.items()
            if goal and len(set(values.values())) > 1 and value == goal(values.values())
        }

    def is_words(self, index: int) -> bool:
        """Return whether a column holds words."""
        return any(isinstance(row[index], str) for row in self.rows)

    def without(self, name: str) -> Table:
        """Return the table without a column, or itself if it has none of that name."""
        keep = [i for i, column in enumerate(self.columns) if column.name != name]
        rows = [tuple(row[i] for i in keep) for row in self.rows]
        return replace(self, columns=tuple(self.columns[i] for i in keep), rows=rows)


@dataclass(frozen=True)
class Figure:
    """A drawing with what it shows and how to read it."""

    title: str
    drawing: Drawing
    note: str = ""


@dataclass(frozen=True)
class Section:
    """What one protocol has to show.

    Attributes:
        name: Word that names files and anchors.
        title: Heading.
        text: What was measured, and how.
        tables: In the order they are read.
        figures: Below the tables.
    """

    name: str
    title: str
    text: str
    tables: list[Table] = field(default_factory=list)
    figures: list[Figure] = field(default_factory=list)

    def of_one_policy(self) -> Section:
        """Return the section without the columns that name the policy."""
        return replace(self, tables=[table.without("policy") for table in self.tables])
