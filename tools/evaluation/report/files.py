"""Reports as files: one HTML page that needs nothing else, and a CSV file for each table."""

from __future__ import annotations

import csv
import io
import re
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from kiras_rl.files import replacing
from kiras_rl.tools.evaluation.report.content import Figure, Section, Table
from kiras_rl.tools.shared.outputs import check_output, refuse

PAGE = "report.html"
TABLES = "tables"
TEMPLATE = "page.html.j2"


def write_report(folder: Path, title: str, about: Table, sections: list[Section]) -> Path:
    """Write the page and its tables.

    Args:
        folder: Where to; made if it is missing.
        title: Of the page.
        about: What was measured: policies and where they come from.
        sections: In the order they are read.

    Returns:
        The page.

    Raises:
        OutputError: As `check_page`.
    """
    check_page(folder)
    page = folder / PAGE
    _write(page, as_html(title, about, sections))  # first: it tells whose the tables are
    for section in sections:
        for table in section.tables:
            _write(folder / TABLES / f"{section.name}_{slug(table.title)}.csv", as_csv(table))
    return page


def _write(path: Path, text: str) -> None:
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def check_page(folder: Path) -> None:
    """Refuse a folder with another page, or with tables that belong to none; before the work.

    Raises:
        OutputError: There is one. A CSV file cannot carry whose it is: the page beside it does.
    """
    page = folder / PAGE
    check_output(page, "<title>KiRAS: ")
    if not page.exists():
        for table in (folder / TABLES).glob("*.csv"):
            refuse(table)


def as_html(title: str, about: Table, sections: list[Section]) -> str:
    """Return the page: styles and pictures within it, so that it opens offline."""
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    environment.globals |= {"svg": as_svg, "slug": slug}
    template = (
        files("kiras_rl.tools.evaluation.report").joinpath(TEMPLATE).read_text(encoding="utf-8")
    )
    page = environment.from_string(template)
    return page.render(title=title, about=about, sections=sections)


def as_csv(table: Table) -> str:
    """Return a table with all digits of its numbers."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(column.heading for column in table.columns)
    writer.writerows(table.rows)
    return text.getvalue()


def as_svg(figure: Figure) -> Markup:
    """Return the drawing as an SVG element."""
    text = io.StringIO()
    # Without a date and with fixed ids, the same results give the same page.
    with _fixed_ids(slug(figure.title)):
        figure.drawing.savefig(text, format="svg", bbox_inches="tight", metadata={"Date": None})
    return Markup(text.getvalue()[text.getvalue().index("<svg") :])


def _fixed_ids(salt: str):  # noqa: ANN202  (a context of matplotlib's)
    import matplotlib

    return matplotlib.rc_context({"svg.hashsalt": salt, "svg.fonttype": "none"})


def slug(title: str) -> str:
    """Return a title as a word for file names and anchors."""
    return re.sub(r"[^a-z0-9]+", "_", title.lower()).strip("_")
