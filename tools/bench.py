"""kiras-bench: how fast everything is on this machine, as ratios within one run."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import TextIO

import matplotlib
import torch
from rich.console import Console
from rich.table import Table

from kiras_rl import checkpoint
from kiras_rl.config import ConfigError, load_config
from kiras_rl.files import replacing
from kiras_rl.schema import Config
from kiras_rl.tools.benchmarks import (
    bound,
    contacts,
    inference,
    iteration,
    learning,
    options,
    peer,
    physics,
    scale,
    terrain,
)
from kiras_rl.tools.benchmarks.request import Figures, Request
from kiras_rl.tools.benchmarks.tables import STYLE
from kiras_rl.tools.shared.arguments import at_least
from kiras_rl.tools.shared.ending import finish
from kiras_rl.tools.shared.outputs import check_output, save_figure
from kiras_rl.tools.training.run import resolve_device

DESCRIPTION = """\
Measure how fast training is here and what each part of it costs. Absolute times depend on the
machine and on what else runs; every figure that counts is therefore a ratio of two variants that
took turns, and the median over the rounds.

physics    steps a second of the environment, against mujoco.batch or mujoco_warp alone on the same
           model, states and targets; target: at least 80 % of its speed, 90 % on a GPU. Then the
           parts of an environment step.
terrain    the same on the terrain with which finetuning begins: against mujoco.batch alone on it,
           target 75 % of its speed, and against flat ground, target at most 2.5 times as long
learning   seconds of an iteration of KiRAS, against stock rsl-rl PPO with the same networks, epochs
           and mini-batches on the same environment; target: at most 1.3 times as long. Stock runs
           twice, the second time with the rollout on one thread, as KiRAS has it; the faster one
           counts. Then the price of each part of KiRAS, from leaving it out. AdaBoot withholds no
           update of the estimator meanwhile: the price is that of a full iteration.
iteration  where the time of an iteration goes, in both phases
bound      seconds of an iteration against what it cannot do without: mujoco.batch over the same
           steps, and the matrix products of the update at the rate of this machine; target: 85 %.
           Always the native backend on the CPU.
inference  control steps of the exported policy on one thread

Only when they are named with --parts, because they take long:

scale      speed and memory of the environment from 256 worlds upwards, doubled until memory is
           short; then of one size on terrain, without height_scan, and with 1, 5 and 10 skills
options    speed against accuracy of MuJoCo's options, on walks of the policy that comes with the
           robot. Always the native backend on the CPU.
contacts   speed against accuracy of the search for contacts with height fields, the only ones that
           search here. C MuJoCo, one thread; the same settings hold on the other backend
peer       the Go1 of this project beside mjlab's; needs --peer, which also adds this part
"""

EXAMPLES = """\
examples:
  kiras-bench --out figures                       the first six parts, Solo-8, 1024 worlds
  kiras-bench --parts physics --worlds 4096       the environment alone
  kiras-bench --parts scale --plot --out figures  pictures, too
  kiras-bench --parts scale --worlds 512,2048     these numbers of worlds, nothing else
  kiras-bench --parts scale sim.backend=warp      the other backend
  kiras-bench --parts peer --peer /opt/mjlab/bin/python
  kiras-bench sim.threads=1 sim.substeps=8        any key of the configuration
  taskset -c 0,1 kiras-bench                      on two cores of many
"""

PARTS: dict[str, ModuleType] = {
    "physics": physics,
    "terrain": terrain,
    "learning": learning,
    "iteration": iteration,
    "bound": bound,
    "inference": inference,
    "scale": scale,
    "options": options,
    "contacts": contacts,
    "peer": peer,
}
USUAL = ("physics", "terrain", "learning", "iteration", "bound", "inference")
WORLDS = 1024
BUSY = 0.5  # mean number of running programs in the last minute

FIGURES, TABLES = "figures.json", "tables.txt"
"""Files in the folder of --out."""
WRITER = "kiras-bench --out"

console = Console()


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    args = _parse(argv)
    return finish(lambda: bench(args))


def _parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="kiras-bench",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--cfg", default="solo8", help="configuration (default: solo8)")
    parser.add_argument(
        "--worlds",
        type=_counts,
        default=(),
        metavar="N[,N...]",
        help=f"scale takes all of them, the other parts the first (default: {WORLDS})",
    )
    parser.add_argument(
        "--rounds", type=at_least(1), default=5, help="that are measured (default: 5)"
    )
    parser.add_argument(
        "--parts", type=_parts, metavar="PART[,PART...]", help=f"(default: {','.join(USUAL)})"
    )
    parser.add_argument(
        "--peer", metavar="PYTHON", help="interpreter of the environment that mjlab is installed in"
    )
    parser.add_argument(
        "--out", type=Path, metavar="FOLDER", help=f"write {FIGURES} and {TABLES} there"
    )
    parser.add_argument("--plot", action="store_true", help="pictures of iteration and scale, too")
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="keys to set")
    args = parser.parse_intermixed_args(argv)
    if args.parts is None:
        args.parts = ("peer",) if args.peer else USUAL
    if "peer" in args.parts and not args.peer:
        parser.error("the part peer needs --peer PYTHON: the environment that mjlab is in")
    if args.plot and not args.out:
        parser.error("--plot needs --out FOLDER: where pictures are written")
    return args


def _counts(text: str) -> tuple[int, ...]:
    return tuple(at_least(1)(word) for word in text.split(","))


def _parts(text: str) -> tuple[str, ...]:
    parts = tuple(text.split(","))
    for part in parts:
        if part not in PARTS:
            raise argparse.ArgumentTypeError(f"no part '{part}'; there are {', '.join(PARTS)}")
    return parts


def bench(args: argparse.Namespace) -> None:
    """Measure, print tables, and save what `args` ask for after each part.

    Raises:
        ConfigError: A configuration that cannot be used.
        OutputError: A file in the folder of --out that another command has written.
    """
    config = _config(args)
    request = Request(
        config,
        args.rounds,
        resolve_device(config.device),
        sizes=args.worlds,
        peer=args.peer,
        tell=console.print,
    )
    _check_outputs(args)
    report: dict[str, Figures] = {"machine": _machine(config), "settings": _settings(args)}
    tables = [_facts("machine", report["machine"])]
    console.print(*tables)
    if os.getloadavg()[0] > BUSY:
        console.print("[yellow]other programs are running: the figures will be noisy[/]")
    for name in args.parts:
        with console.status(f"measuring {name} ..."):
            report[name] = PARTS[name].measure(request)
        shown = PARTS[name].table(report[name])
        _print(shown, console)
        tables += shown
        if args.out is None:
            continue
        _save(args.out, report, tables)
        if args.plot and hasattr(PARTS[name], "plot"):
            with matplotlib.rc_context(STYLE):
                save_figure(PARTS[name].plot(report[name]), args.out / f"{name}.png", WRITER)


def _check_outputs(args: argparse.Namespace) -> None:
    """Refuse now what would be refused after the measurements."""
    if args.out is None:
        return
    plotted = [f"{name}.png" for name in args.parts if args.plot and hasattr(PARTS[name], "plot")]
    for name in (FIGURES, TABLES, *plotted):
        check_output(args.out / name, WRITER)


def _config(args: argparse.Namespace) -> Config:
    if any(item.startswith("num_envs=") for item in args.overrides):
        raise ConfigError("num_envs cannot be set here: use --worlds")
    if args.out:
        args.out.mkdir(parents=True, exist_ok=True)
    config = load_config(args.cfg, args.overrides)
    return replace(config, num_envs=args.worlds[0] if args.worlds else WORLDS)


def _settings(args: argparse.Namespace) -> Figures:
    return {
        "writer": WRITER,
        "cfg": args.cfg,
        "overrides": args.overrides,
        "worlds": list(args.worlds) or [WORLDS],
        "rounds": args.rounds,
    }


def _machine(config: Config) -> Figures:
    cores = len(os.sched_getaffinity(0))
    return {
        "CPU": _cpu_model(),
        "cores": cores,
        "GPU": torch.cuda.get_device_name() if torch.cuda.is_available() else "none",
        "threads of MuJoCo": config.sim.threads or cores,
        "threads of torch": torch.get_num_threads(),
        "load in the last minute": os.getloadavg()[0],  # what already runs, in cores
        **checkpoint.versions(),
    }


def _cpu_model() -> str:
    """Return the name of the processor; `platform.processor` knows it on no common Linux."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text("utf-8").splitlines() if path.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else os.uname().machine


def _facts(title: str, facts: Figures) -> Table:
    table = Table(title=title, title_justify="left", show_header=False)
    for name, value in facts.items():
        table.add_row(name, f"{value:.1f}" if isinstance(value, float) else str(value))
    return table


def _save(folder: Path, report: dict[str, Figures], tables: Iterable[Table]) -> None:
    """Write all figures and tables until now: a part that fails later loses none of them."""
    with replacing(folder / FIGURES) as figures, replacing(folder / TABLES) as text:
        figures.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
        with text.open("w", encoding="utf-8") as file:
            file.write(f"{WRITER}\n\n")
            _print(tables, _plain(file))


def _plain(file: TextIO) -> Console:
    return Console(file=file, width=160, color_system=None)


def _print(tables: Iterable[Table], to: Console) -> None:
    for table in tables:
        to.print(table, "")


if __name__ == "__main__":
    sys.exit(main())
