"""kiras-compare: several policies by the same protocols, side by side."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from kiras_rl.config import ConfigError
from kiras_rl.tools.evaluate import (
    add_options,
    chosen,
    console,
    exit_code,
    measure,
    options_of,
)
from kiras_rl.tools.evaluation.protocols import PROTOCOLS
from kiras_rl.tools.evaluation.protocols.pooling import pool
from kiras_rl.tools.evaluation.protocols.subject import Options, Subject
from kiras_rl.tools.evaluation.report.about import about_table
from kiras_rl.tools.evaluation.report.content import Section
from kiras_rl.tools.evaluation.report.files import check_page, write_report
from kiras_rl.tools.evaluation.report.terminal import as_rich

DESCRIPTION = """\
Measure several policies by the protocols of kiras-evaluate and set them side by side: tables are
printed, and a folder gets report.html, which opens offline, and tables/*.csv.

A policy is a run folder, a checkpoint, an ONNX file, or a folder with runs in seed_*/, as
kiras-train --sweep makes them: then its values are means over the seeds. NAME=PATH gives it a name.
What kiras-evaluate has measured of a policy is not measured again.
"""

EXAMPLES = """\
examples:
  kiras-compare flat=runs/a/2026-01-31_12-00-00/checkpoints/flat.pt rough=runs/a/2026-01-31_12-00-00
  kiras-compare runs/sweeps/ablations/* --protocol imitation,heat_map --out comparison
"""


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    args = _parse(argv)
    return exit_code(
        lambda: compare(load(args.policies, options_of(args)), args.protocol, args.out)
    )


def _parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="kiras-compare",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("policies", nargs="+", metavar="[NAME=]POLICY", help="what to compare")
    add_options(parser)
    parser.set_defaults(out=Path("comparison"))
    return parser.parse_args(argv)


def load(sources: list[str], options: Options) -> dict[str, list[Subject]]:
    """Load what is compared: a name, and a policy for each seed.

    Raises:
        ConfigError: Two policies of one name, or of different robots.
        PolicyError: No policy where a source points.
    """
    methods: dict[str, list[Subject]] = {}
    for source in sources:
        name, path = _split(source)
        seeds = sorted(path.glob("seed_*")) if path.is_dir() else []
        subjects = [Subject.load(p, None, None, options) for p in seeds or [path]]
        label = name or (path.name if seeds else subjects[0].label)
        if label in methods:
            raise ConfigError(f"two policies are called '{label}': name them, as in NAME={path}")
        methods[label] = subjects
    robots = {s.onboard.metadata.robot for subjects in methods.values() for s in subjects}
    if len(robots) > 1:
        raise ConfigError(
            f"the policies are of different robots ({', '.join(sorted(robots))}): compare those of "
            "one"
        )
    return methods


def _split(source: str) -> tuple[str, Path]:
    """Return the name, empty where none is given, and the path of a policy."""
    name, separator, path = source.partition("=")
    return (name, Path(path)) if separator and not Path(source).exists() else ("", Path(source))


def compare(methods: dict[str, list[Subject]], names: list[str] | None, out: Path) -> Path:
    """Measure what is missing and write the report after each protocol; return its page."""
    check_page(out)
    subjects = [subject for group in methods.values() for subject in group]
    sections: list[Section] = []
    page = out
    for name, values in measure(subjects, chosen(names, subjects)):
        rest = iter(values)
        results = {label: pool([next(rest) for _ in group]) for label, group in methods.items()}
        sections.append(PROTOCOLS[name].section(results))
        for table in sections[-1].tables:
            console.print(as_rich(table))
        page = write_report(out, f"KiRAS: {' / '.join(methods)}", about_table(subjects), sections)
    console.print(f"report: {page}", highlight=False, soft_wrap=True)
    return page


if __name__ == "__main__":
    sys.exit(main())
