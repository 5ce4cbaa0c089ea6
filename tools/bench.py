"""kiras-bench: measure what the environment and the learner cost, as ratios within one run."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from statistics import median

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from kiras_rl import checkpoint
from kiras_rl.config import ConfigError, load_config
from kiras_rl.deploy.policy import PolicyError
from kiras_rl.robots.robot import RobotError
from kiras_rl.schema import Config
from kiras_rl.tools import bench_environment as environment
from kiras_rl.tools import bench_learning as learning
from kiras_rl.tools.bench_inference import measure_inference
from kiras_rl.tools.timing import Times, ratios, summarise
from kiras_rl.tools.training import resolve_device

DESCRIPTION = """\
Measure how fast training is here and what each part of it costs. Absolute times depend on the
machine and on what else runs; every figure that counts is therefore a ratio of two variants that
took turns, and the median over the rounds.

physics    steps a second of the environment, against mujoco.batch alone on the same model, states
           and targets; target: at least 80 % of its speed. Then the parts of an environment step.
           Always the native backend on the CPU.
terrain    the same on the terrain with which finetuning begins: against mujoco.batch alone on it,
           target 75 % of its speed, and against flat ground, target at most 2.5 times as long
learning   seconds of an iteration of KiRAS, against stock rsl-rl PPO with the same networks, epochs
           and mini-batches on the same environment; target: at most 1.3 times as long. Stock runs
           twice, the second time with the rollout on one thread, as KiRAS has it; the faster one
           counts. Then the price of each part of KiRAS, from leaving it out. AdaBoot withholds no
           update of the estimator meanwhile: the price is that of a full iteration.
inference  control steps of the exported policy on one thread

With 1024 worlds and 5 rounds this takes about four minutes on two quiet cores.
"""

EXAMPLES = """\
examples:
  kiras-bench                                     everything, Solo-8, 1024 worlds
  kiras-bench --parts physics --worlds 4096       the environment alone
  kiras-bench --parts learning --json out.json    all rounds' figures in a file, too
  kiras-bench sim.threads=1 sim.substeps=8        any key of the configuration
  taskset -c 0,1 kiras-bench                      on two cores of many
"""

SPEED_TARGET = 0.8  # of bare mujoco.batch
TERRAIN_SPEED_TARGET = 0.75  # of bare mujoco.batch on the same terrain
TERRAIN_COST_TARGET = 2.5  # times a step on flat ground
PRICE_TARGET = 1.3  # iterations of stock rsl-rl PPO
BUSY = 0.5  # mean number of running programs in the last minute

Figures = dict[str, object]

console = Console()


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    args = _parse(argv)
    try:
        report = bench(args)
        if args.json:
            args.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    except (ConfigError, PolicyError, RobotError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="kiras-bench",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--cfg", default="solo8", help="configuration (default: solo8)")
    parser.add_argument("--worlds", type=_count, default=1024, help="(default: 1024)")
    parser.add_argument("--rounds", type=_count, default=5, help="that are measured (default: 5)")
    parser.add_argument(
        "--parts", type=_parts, default=tuple(PARTS), help=f"(default: {','.join(PARTS)})"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures there")
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="keys to set")
    return parser.parse_intermixed_args(argv)


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number of at least 1")
    return int(text)


def _parts(text: str) -> tuple[str, ...]:
    parts = tuple(text.split(","))
    for part in parts:
        if part not in PARTS:
            raise argparse.ArgumentTypeError(f"no part '{part}'; there are {', '.join(PARTS)}")
    return parts


def bench(args: argparse.Namespace) -> dict[str, Figures]:
    """Measure, print tables and return all figures.

    Raises:
        ConfigError: A configuration that cannot be used.
    """
    config = _config(args)
    report: dict[str, Figures] = {"machine": _machine(config), "settings": _settings(args)}
    console.print(_facts("machine", report["machine"]))
    if os.getloadavg()[0] > BUSY:
        console.print("[yellow]other programs are running: the figures will be noisy[/]")
    for part in args.parts:
        with console.status(f"measuring {part} ..."):
            report[part], tables = PARTS[part](config, args.rounds)
        for table in tables:
            console.print(table, "")
    return report


def _config(args: argparse.Namespace) -> Config:
    if any(item.startswith("num_envs=") for item in args.overrides):
        raise ConfigError("num_envs cannot be set here: use --worlds")
    if args.json and not args.json.parent.is_dir():
        raise ConfigError(f"--json {args.json}: there is no folder {args.json.parent}")
    config = load_config(args.cfg, args.overrides)
    return replace(config, num_envs=args.worlds)


def _settings(args: argparse.Namespace) -> Figures:
    return {
        "cfg": args.cfg,
        "overrides": args.overrides,
        "worlds": args.worlds,
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


# --- parts --------------------------------------------------------------------------------------


def _physics(config: Config, rounds: int) -> tuple[Figures, list[Table]]:
    measured = environment.measure_environment(config, rounds)
    steps = measured.steps
    speed = {name: summarise(ratios(steps, environment.BARE, name)) for name in steps}
    rates = {name: config.num_envs / median(times) for name, times in steps.items()}
    figures: Figures = {
        "seconds_per_step": {name: summarise(times) for name, times in steps.items()},
        "steps_per_second": rates,
        "share_of_bare_speed": speed,
        "target": SPEED_TARGET,
        "share_of_worlds_reset": measured.resets,
        "parts_seconds": {part: median(times) for part, times in measured.parts.items()},
        "rounds": asdict(measured),
    }
    title = f"control steps of {config.num_envs} worlds"
    table = _table(title, "ms", "env steps/s", "of bare speed", "range")
    for name, times in steps.items():
        ms = f"{1e3 * median(times):.2f}"
        table.add_row(name, ms, f"{rates[name]:,.0f}", *_with_range(speed[name]))
    reached = speed[environment.ENVIRONMENT]["median"]
    table.caption = _verdict(reached >= SPEED_TARGET, f"target: at least {SPEED_TARGET}")
    return figures, [table, _parts_of_a_step(measured)]


def _parts_of_a_step(measured: environment.EnvironmentTimes) -> Table:
    seconds = {part: median(times) for part, times in measured.parts.items()}
    whole = sum(seconds.values())
    title = f"one environment step ({100 * measured.resets:.1f} % of the worlds reset)"
    table = _table(title, "ms", "%")
    for part, value in seconds.items():
        table.add_row(part, f"{1e3 * value:.2f}", f"{100 * value / whole:.1f}")
    return table


def _terrain(config: Config, rounds: int) -> tuple[Figures, list[Table]]:
    steps = environment.measure_terrain(config, rounds)
    share = summarise(ratios(steps, environment.BARE_TERRAIN, environment.TERRAIN))
    cost = summarise(ratios(steps, environment.TERRAIN, environment.ENVIRONMENT))
    columns = ("ms", "env steps/s", "of bare speed", "times flat ground")
    table = _table(f"control steps of {config.num_envs} worlds", *columns)
    for name, times in steps.items():
        row = [f"{1e3 * median(times):.2f}", f"{config.num_envs / median(times):,.0f}"]
        if name == environment.TERRAIN:
            row += ["{} ({})".format(*_with_range(figure)) for figure in (share, cost)]
        table.add_row(name, *row)
    fast, cheap = share["median"] >= TERRAIN_SPEED_TARGET, cost["median"] <= TERRAIN_COST_TARGET
    table.caption = "\n".join(
        (
            _verdict(fast, f"target: at least {TERRAIN_SPEED_TARGET} of bare speed"),
            _verdict(cheap, f"target: at most {TERRAIN_COST_TARGET} times flat ground"),
        )
    )
    figures: Figures = {
        "seconds_per_step": {name: summarise(times) for name, times in steps.items()},
        "share_of_bare_speed": share,
        "times_flat": cost,
        "targets": [TERRAIN_SPEED_TARGET, TERRAIN_COST_TARGET],
        "rounds": steps,
    }
    return figures, [table]


def _learning(config: Config, rounds: int) -> tuple[Figures, list[Table]]:
    measured = learning.measure_learning(config, rounds, resolve_device(config.device))
    times, updates = measured.iterations, measured.updates
    stock = min(learning.STOCK, learning.STOCK_SINGLE, key=lambda name: median(times[name]))
    against = {name: summarise(ratios(times, name, stock)) for name in times}
    prices = _prices(times)
    figures: Figures = {
        "seconds_per_iteration": {name: summarise(t) for name, t in times.items()},
        "seconds_per_update": {name: summarise(t) for name, t in updates.items()},
        "reference": stock,
        "times_reference": against,
        "target": PRICE_TARGET,
        "price_seconds": prices,
        "rounds": asdict(measured),
    }
    title = f"iterations of {config.num_envs} worlds x {config.learner.ppo.num_steps} steps"
    table = _table(title, "s", "update, s", "ratio", "range")
    for name, t in times.items():
        seconds = (f"{median(t):.3f}", f"{median(updates[name]):.3f}")
        table.add_row(name, *seconds, *_with_range(against[name]))
    reached = against[learning.KIRAS]["median"]
    target = f"reference: {stock}; target: at most {PRICE_TARGET}"
    table.caption = _verdict(reached <= PRICE_TARGET, target)
    return figures, [table, _price_list(prices, median(times[learning.KIRAS]))]


def _prices(times: Times) -> dict[str, float]:
    """Return how much longer an iteration with a part takes than without, the median, s."""
    full = times[learning.KIRAS]
    return {
        part: median(a - b for a, b in zip(full, times[learning.without(part)], strict=True))
        for part in learning.REMOVABLE
        if learning.without(part) in times
    }


def _price_list(prices: dict[str, float], whole: float) -> Table:
    table = _table("price of a part of KiRAS", "s an iteration", "% of KiRAS")
    for part, seconds in prices.items():
        table.add_row(part, f"{seconds:+.3f}", f"{100 * seconds / whole:+.1f}")
    return table


def _inference(config: Config, rounds: int) -> tuple[Figures, list[Table]]:
    middle, slow = np.quantile(measure_inference(config, rounds), (0.5, 0.99)).tolist()
    table = _table("exported policy, one thread", "median, ms", "p99, ms")
    table.add_row("control step", f"{1e3 * middle:.3f}", f"{1e3 * slow:.3f}")
    return {"median_seconds": middle, "p99_seconds": slow}, [table]


Part = Callable[[Config, int], tuple[Figures, list[Table]]]

PARTS: dict[str, Part] = {
    "physics": _physics,
    "terrain": _terrain,
    "learning": _learning,
    "inference": _inference,
}


# --- tables -------------------------------------------------------------------------------------


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", caption_justify="left")
    table.add_column("", no_wrap=True)
    for column in columns:
        table.add_column(column, justify="right")
    return table


def _facts(title: str, facts: Figures) -> Table:
    table = Table(title=title, title_justify="left", show_header=False)
    for name, value in facts.items():
        table.add_row(name, f"{value:.1f}" if isinstance(value, float) else str(value))
    return table


def _with_range(summary: dict[str, float]) -> tuple[str, str]:
    return f"{summary['median']:.2f}", f"{summary['min']:.2f} to {summary['max']:.2f}"


def _verdict(is_met: bool, target: str) -> str:
    return f"[green]{target}: met[/]" if is_met else f"[red]{target}: missed[/]"


if __name__ == "__main__":
    sys.exit(main())
