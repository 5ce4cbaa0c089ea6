"""kiras-train: train a robot's skills."""

from __future__ import annotations

import argparse
import datetime
import logging
import shlex
import shutil
import sys
from pathlib import Path

from kiras_rl import distributed
from kiras_rl.checkpoint import FLAT, FOLDER, LATEST, find_checkpoint
from kiras_rl.config import ConfigError, list_configs, load_config
from kiras_rl.deploy.errors import PlainError
from kiras_rl.ownership import owning
from kiras_rl.process import StopRequest
from kiras_rl.runner import KirasRunner
from kiras_rl.tools.driving.side_by_side import train_side_by_side
from kiras_rl.tools.shared.arguments import at_least
from kiras_rl.tools.shared.ending import finish, is_out_of_memory
from kiras_rl.tools.training.run import (
    begin,
    console,
    message_of,
    resume,
    run_of,
    train_run,
)
from kiras_rl.tools.training.sweep import list_sweeps, load_sweep, train_sweep

DESCRIPTION = """\
Train one policy for all skills of a robot.

A configuration is a file of cfg/ (give its name) or a YAML file of your own (give its path); any
key can be set on the command line. Every key is explained in cfg/base.yaml.

A run lives in runs/<configuration>/<time>/: config.yaml, checkpoints/, the TensorBoard log,
policy.onnx and curves.png. Ctrl-C stops after the current iteration and saves; --resume goes on
exactly where it stopped.

A sweep is a file of cfg/sweeps/ or your own: configurations and seeds, trained one after the other
in runs/sweeps/<name>/<label>/seed_<n>/; with --jobs several at a time, each on its share of the
cores. The same command goes on where it was interrupted.
"""

EXAMPLES = """\
examples:
  kiras-train --cfg solo8_quick                       twelve minutes on two CPU cores
  kiras-train --cfg solo8 num_envs=2048 seed=2        set keys
  kiras-train --cfg ablations/no_sil iterations=300   a part of the method left out
  kiras-train --cfg mine.yaml                         your own file, with "extends: solo8"
  kiras-train --resume runs/solo8/2026-01-31_12-00-00
  kiras-train --cfg solo8 --flat runs/solo8/2026-01-31_12-00-00   its skills, finetuned anew
  kiras-train --sweep ablations                       KiRAS and its ablations, two seeds each
  kiras-train --sweep ablations --jobs 2              two of them at a time
  kiras-train --sweep mine.yaml num_envs=512          your own sweep, a key set in all its runs
  torchrun --nproc-per-node 4 -m kiras_rl.tools.train --cfg solo8   on four GPUs
  tensorboard --logdir runs
"""


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    args = _parse(argv)
    logging.basicConfig(format="%(message)s")
    return finish(lambda: _run(args))


def _run(args: argparse.Namespace) -> int:
    try:
        with distributed.group():
            return _train(args)
    except distributed.RankLostError as error:
        print(
            f"error: {error}; the last checkpoint stays as it is: go on with --resume",
            file=sys.stderr,
        )
        return 1
    except Exception as error:
        short = isinstance(error, OSError) or is_out_of_memory(error)
        if not short and not isinstance(error, PlainError):
            raise
        # The others of a machine make the same, but for what their disk or memory refuses.
        if distributed.local_rank() == 0 or short:
            print(f"error: {message_of(error)}", file=sys.stderr)
        return 2


def _parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="kiras-train",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--cfg", help=f"configuration; shipped: {', '.join(list_configs())}")
    source.add_argument("--resume", type=Path, help="run folder or checkpoint to go on with")
    source.add_argument("--sweep", help=f"list of runs; shipped: {', '.join(list_sweeps())}")
    parser.add_argument(
        "--flat",
        type=Path,
        help="with --cfg: run folder or checkpoint of an earlier skill learning; begin terrain "
        "finetuning with its best policy",
    )
    parser.add_argument(
        "--jobs",
        type=at_least(1),
        metavar="N",
        help="with --sweep: runs that train at a time, at most one a core (default: 1)",
    )
    parser.add_argument(
        "--only",
        metavar="LABEL/seed_N",
        help="with --sweep: train this run of it and no other, as one job of a cluster, say",
    )
    parser.add_argument(
        "--changed-robot",
        action="store_true",
        help="with --resume: go on with today's robot though its files have changed since",
    )
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="where runs are written")
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="keys to set")
    return parser.parse_intermixed_args(argv)


def _train(args: argparse.Namespace) -> int:
    console.quiet = not distributed.is_main()
    if distributed.is_main():
        logging.getLogger("kiras_rl").setLevel(logging.INFO)  # "kernels compile": minutes, once
    if args.sweep:
        return _train_sweep(args)
    if args.jobs or args.only:
        raise ConfigError("--jobs and --only are about the runs of a sweep: give them with --sweep")
    return _train_one(args)


def _train_one(args: argparse.Namespace) -> int:
    if args.changed_robot and args.resume is None:
        raise ConfigError("--changed-robot is about a run that goes on: give it with --resume")
    if args.resume is None:
        return _train_run(_new_run(args))
    if args.flat is not None:
        raise ConfigError("--flat begins a new run: give it with --cfg, not with --resume")
    source = _find(args.resume, LATEST)
    with owning(run_of(source)):
        return _train_run(resume(source, args.overrides, args.changed_robot))


def _train_run(runner: KirasRunner) -> int:
    with StopRequest() as stop:
        finished = train_run(runner, stop)
    if not finished:
        folder = shlex.quote(str(runner.run_dir))
        _say(f"stopped and saved; go on with: {_command()} --resume {folder}")
    return 0


def _command() -> str:
    if distributed.size() == 1:
        return "kiras-train"
    return f"torchrun --nproc-per-node {distributed.local_size()} -m kiras_rl.tools.train"


def _new_run(args: argparse.Namespace) -> KirasRunner:
    config = load_config(args.cfg, args.overrides)
    flat = _find(args.flat, FLAT) if args.flat else None
    runner = begin(config, flat)
    runner.run_dir = distributed.from_main(lambda: _make_folder(args, flat))
    return runner


def _find(source: Path, prefer: str) -> Path:
    return distributed.from_main(lambda: find_checkpoint(source, prefer))


def _make_folder(args: argparse.Namespace, flat: Path | None) -> Path:
    run_dir = claim(_new_run_dir(args.runs, args.cfg))
    if flat:
        (run_dir / FOLDER).mkdir()
        shutil.copyfile(flat, run_dir / FOLDER / FLAT)
    return run_dir


def _new_run_dir(runs: Path, cfg: str) -> Path:
    name = cfg.removesuffix(".yaml") if not Path(cfg).is_file() else Path(cfg).stem
    stamp = datetime.datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    return runs / name / stamp


def claim(folder: Path) -> Path:
    """Make a new folder; where one is there, of a run begun in the same second, add a number."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    name, number = folder.name, 1
    while True:
        try:
            folder.mkdir()
            return folder
        except FileExistsError:
            number += 1
            folder = folder.with_name(f"{name}.{number}")


def _train_sweep(args: argparse.Namespace) -> int:
    if args.flat is not None:
        raise ConfigError("--flat begins a new run: give it with --cfg, not with --sweep")
    if distributed.size() > 1:
        raise ConfigError("--sweep trains on one process: start it without torchrun")
    if args.only and args.jobs:
        raise ConfigError("--only names one run, --jobs is for several: leave one of them out")
    runs = load_sweep(args.sweep, args.overrides, args.runs, args.only)
    command = _sweep_arguments(args)
    report = train_side_by_side(runs, args.jobs, command) if args.jobs else train_sweep(runs)
    if args.only is None:
        console.print(report.table())
    if report.stopped:
        only = ["--only", args.only] if args.only else []
        jobs = ["--jobs", str(args.jobs)] if args.jobs else []
        again = shlex.join(["kiras-train", *command, *only, *jobs])
        _say(f"stopped and saved; go on with: {again}")
    return 1 if report.failures else 0


def _sweep_arguments(args: argparse.Namespace) -> list[str]:
    """Return the arguments that name this sweep and its runs."""
    where = [] if args.runs == Path("runs") else ["--runs", str(args.runs)]
    return ["--sweep", args.sweep, *where, *args.overrides]


def _say(message: str) -> None:
    console.print(message, highlight=False, markup=False, soft_wrap=True)


if __name__ == "__main__":
    sys.exit(main())
