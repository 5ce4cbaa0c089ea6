"""Where the measured policies come from."""

from __future__ import annotations

from kiras_rl.tools.evaluation.protocols.subject import Subject
from kiras_rl.tools.evaluation.report.content import Column, Table

COLUMNS = (
    Column("policy"),
    Column("robot"),
    Column("iterations", form="{}"),
    Column("steps", "million", "{:.1f}"),
    Column("training", "min", "{:.0f}"),
    Column("seed", form="{}"),
    Column("commit"),
    Column("file"),
)


def about_table(subjects: list[Subject]) -> Table:
    """Return a row a policy, from its own provenance."""
    rows = []
    for subject in subjects:
        p = subject.onboard.metadata.provenance
        steps = p.get("steps")
        rows.append(
            (
                subject.label,
                subject.onboard.metadata.robot,
                p.get("iterations"),
                None if steps is None else steps / 1e6,
                p.get("minutes"),
                p.get("config", {}).get("seed"),
                p.get("commit"),
                str(subject.source),
            )
        )
    return Table("What was measured", COLUMNS, rows)
