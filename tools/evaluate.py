"""kiras-evaluate: measure a policy by fixed protocols."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from kiras_rl.evaluation.flat import SETTLE
from kiras_rl.tools.evaluation.protocols import PROTOCOLS, known
from kiras_rl.tools.evaluation.protocols.subject import Options, Subject
from kiras_rl.tools.evaluation.protocols.terrain import LEVELS
from kiras_rl.tools.evaluation.report.about import about_table
from kiras_rl.tools.evaluation.report.content import Section
from kiras_rl.tools.evaluation.report.files import check_page, write_report
from kiras_rl.tools.evaluation.report.terminal import as_rich
from kiras_rl.tools.shared.arguments import at_least, seconds_above
from kiras_rl.tools.shared.console import make_console
from kiras_rl.tools.shared.ending import finish
from kiras_rl.tools.training.run import resolve_device

DESCRIPTION = """\
Measure a policy without action noise, through the code that runs on the robot, on robots drawn by
their domain randomization, with sensor noise, actuation delay and pushes.

Tables are printed; a folder gets report.html, which opens offline, tables/*.csv and results.json.
That folder is evaluation/ of a run, or evaluation/<policy>/. An interrupted evaluation goes on
where it was when the same command is given again.

Without --protocol: flat, imitation, transitions, for a run sampling and learning, and for a policy
that was finetuned terrain.

"""

EXAMPLES = """\
examples:
  kiras-evaluate                              the policy shipped with Solo-8
  kiras-evaluate runs/solo8_quick/2026-01-31_12-00-00
  kiras-evaluate policy.onnx --protocol imitation,transitions
  kiras-evaluate policy.onnx --protocol terrain --levels 4,5 --trials 100
  kiras-evaluate policy.onnx --protocol heat_map   twenty minutes on two CPU cores
"""

"""Errors whose message is all that a user needs; what a file or folder refuses is one."""

ALL = list(PROTOCOLS)

console = make_console()


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    args = _parse(argv)

    def work() -> None:
        subject = Subject.load(args.policy, args.robot, args.out, options_of(args))
        evaluate(subject, chosen(args.protocol, [subject]))

    return exit_code(work)


def exit_code(work: Callable[[], object]) -> int:
    """Do the work of a command, see `finish`; return its exit status."""

    def measure_and_write() -> None:
        work()

    return finish(measure_and_write, "stopped; the same command goes on from here")


def evaluate(subject: Subject, names: list[str]) -> Path:
    """Run protocols, print their tables and write the report after each; return its page."""
    check_page(subject.folder)
    sections: list[Section] = []
    page = subject.folder
    for name, values in measure([subject], names):
        section = PROTOCOLS[name].section({subject.label: values[0]})
        sections.append(section.of_one_policy())
        for table in sections[-1].tables:
            console.print(as_rich(table))
        title = f"KiRAS: {subject.label}"
        page = write_report(subject.folder, title, about_table([subject]), sections)
    console.print(f"report: {page}", highlight=False, soft_wrap=True)
    return page


def measure(subjects: list[Subject], names: list[str]) -> Iterator[tuple[str, list[dict]]]:
    """Yield the name of each protocol and its values for every subject.

    A bar shows how much of a protocol is done, and the time left; a file gets a line a protocol.
    """
    with _bar() as bar:
        for number, name in enumerate(names, start=1):
            title = f"{name} ({number} of {len(names)})"
            if bar.disable:
                console.print(f"measuring {title}", highlight=False)
            values = []
            for subject in subjects:
                task = bar.add_task(f"{title}: {subject.label}", total=1.0)
                subject.progress.show = lambda share, task=task: bar.update(task, completed=share)
                values.append(PROTOCOLS[name].measure(subject))
                bar.remove_task(task)
            yield name, values


def _bar() -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn())
    return Progress(
        *columns,
        TimeRemainingColumn(),
        console=console,
        transient=True,
        refresh_per_second=2,
        disable=not console.is_terminal,
    )


def chosen(names: list[str] | None, subjects: list[Subject]) -> list[str]:
    """Return the protocols to measure: those named, else what makes sense for the policies.

    Args:
        names: Given by the user; what they name is measured, or refused with a reason.
        subjects: All that is measured.
    """
    if names and names != ALL:
        return names
    return known(names or _defaults(subjects), subjects)


def _defaults(subjects: list[Subject]) -> list[str]:
    names = ["flat", "imitation", "limits", "transitions", "sampling", "learning"]
    return names + ["terrain"] * any(subject.is_finetuned for subject in subjects)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add what kiras-evaluate and kiras-compare have in common."""
    parser.add_argument(
        "--protocol", type=_protocols, help=f"all, or some of {','.join(PROTOCOLS)}"
    )
    default = Options()
    parser.add_argument(
        "--robots", type=at_least(1), default=default.robots,
        help="robots a skill (flat, imitation, robustness)",
    )  # fmt: skip
    parser.add_argument(
        "--duration", type=seconds_above(SETTLE), default=default.duration,
        help=f"s a robot (flat); the first {SETTLE:g} is not counted",
    )  # fmt: skip
    parser.add_argument("--trials", type=at_least(1), help="of a cell (the others)")
    parser.add_argument(
        "--levels", type=_levels, default=default.levels, help="of terrain, 0 to 10, as in 2,4,6"
    )
    parser.add_argument("--command", type=float, default=default.command, help="v_x, m/s")
    parser.add_argument("--nominal", action="store_true", help="no randomization, noise or pushes")
    parser.add_argument("--backend", choices=("auto", "native", "warp"), default="auto")
    parser.add_argument("--device", default="cpu", help="of the simulation: cpu or cuda")
    parser.add_argument("--out", type=Path, help="folder of the report")


def options_of(args: argparse.Namespace) -> Options:
    """Return the options that `add_options` parsed."""
    given = {name: getattr(args, name) for name in Options.__dataclass_fields__}
    given["device"] = resolve_device(args.device)
    return Options(**given)


def _parse(argv: list[str] | None) -> argparse.Namespace:
    protocols = "\n".join(f"{name:<12} {p.TITLE.lower()}" for name, p in PROTOCOLS.items())
    parser = argparse.ArgumentParser(
        prog="kiras-evaluate",
        description=DESCRIPTION + protocols,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("policy", nargs="?", type=Path, help="run folder, checkpoint or ONNX file")
    parser.add_argument("--robot", help="whose shipped policy, if none is given (solo8)")
    add_options(parser)
    return parser.parse_args(argv)


def _protocols(text: str) -> list[str]:
    if text == "all":
        return ALL
    names = text.split(",")
    unknown = [name for name in names if name not in PROTOCOLS]
    if unknown:
        raise argparse.ArgumentTypeError(
            f"unknown protocol '{unknown[0]}'; allowed are all, {', '.join(PROTOCOLS)}"
        )
    return names


def _levels(text: str) -> tuple[int, ...]:
    levels = tuple(int(part) for part in text.split(",") if part.isdigit())
    if len(levels) != text.count(",") + 1 or max(levels) >= LEVELS:
        raise argparse.ArgumentTypeError(f"'{text}': give levels from 0 to {LEVELS - 1}, as in 4,5")
    return levels


if __name__ == "__main__":
    sys.exit(main())
