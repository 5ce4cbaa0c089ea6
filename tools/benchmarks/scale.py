"""How speed and memory of the environment grow with worlds, and what terrain and skills cost.

Each figure is measured in a process of its own: memory that one environment leaves behind would
hide what the next one takes, and a process that is killed for memory ends no benchmark.
"""

from __future__ import annotations

import copy
import itertools
import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path
from statistics import median

import torch
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, ScalarFormatter
from rich.table import Table

from kiras_rl.envs import make_env, resolve_backend
from kiras_rl.phases import plan
from kiras_rl.process import single_threaded
from kiras_rl.robots.robot import Robot, load_robot
from kiras_rl.schema import Config
from kiras_rl.tools.benchmarks.request import Figures, Request
from kiras_rl.tools.benchmarks.tables import make_table
from kiras_rl.tools.benchmarks.workload import Workload

FIRST = 256
LARGEST = {"cpu": 8192, "cuda": 131072}
"""Device -> worlds after which doubling ends: more gain nothing on two cores, or on any GPU."""

SKILLS = (1, 5, 10)
FLAT, ROUGH = "flat ground", "terrain"
WITHOUT_SCAN = "without height_scan"


def measure(request: Request) -> Figures:
    """Time environments of many sizes, then of one size with more and less in them.

    Where sizes are asked for, nothing but these is measured.

    Raises:
        ConfigError: As `make_env`.
        RobotError: As `make_env`.
    """
    flat = plan(request.config)[0].config
    sizes, stopped = _grow(request, flat)
    return {
        "device": request.device,
        "backend": resolve_backend(flat.sim.backend, torch.device(request.device)),
        "robot": flat.robot,
        "sizes": sizes,
        "stopped": stopped,
        "worlds": flat.num_envs,
        "variants": {
            name: _alone(name, config, request, skills)
            for name, (config, skills) in _variants(request.config).items()
            if not request.sizes
        },
    }


def _grow(request: Request, config: Config) -> tuple[list[Figures], str | None]:
    """Return the figures of each size, and why there is no larger one; None if all were run."""
    sizes: list[Figures] = []
    for worlds in request.sizes or _doubled(request.device):
        if sizes and (short := _too_large(sizes[-1], worlds, request.device)):
            return sizes, short
        try:
            sizes.append(_alone(f"{worlds:,} worlds", replace(config, num_envs=worlds), request))
        except (BrokenProcessPool, MemoryError, RuntimeError) as error:
            if not sizes or not _is_memory(error):
                raise
            return sizes, f"{worlds} worlds ran out of memory"
    return sizes, None


def _doubled(device: str) -> Iterator[int]:
    largest = LARGEST[torch.device(device).type]
    return itertools.takewhile(lambda n: n <= largest, (FIRST << k for k in itertools.count()))


def _too_large(last: Figures, worlds: int, device: str) -> str | None:
    """Tell why a size would not fit, by what the one before it took."""
    needed = last["memory_bytes"] * worlds / last["worlds"]
    free = available_memory(device)
    if needed <= 0.9 * free:
        return None
    return f"{worlds} worlds would take {needed / 1e9:.1f} GB of {free / 1e9:.1f} GB"


def _is_memory(error: Exception) -> bool:
    return isinstance(error, BrokenProcessPool | MemoryError) or "memory" in str(error).lower()


def _variants(config: Config) -> dict[str, tuple[Config, int | None]]:
    """Return configurations with more and less in them, and the skills of the robot."""
    variants: dict[str, tuple[Config, int | None]] = {}
    for ground, phase in zip((FLAT, ROUGH), plan(config), strict=False):
        alone = phase.config
        variants[ground] = alone, None
        if alone.env.observations.critic.get("height_scan") is not None:
            blind = copy.deepcopy(alone)
            blind.env.observations.critic["height_scan"] = None
            variants[f"{ground}, {WITHOUT_SCAN}"] = blind, None
    for count in SKILLS:
        variants[f"{FLAT}, {count} skill{'s' if count > 1 else ''}"] = variants[FLAT][0], count
    return variants


def _alone(name: str, config: Config, request: Request, skills: int | None = None) -> Figures:
    """Measure an environment in a process that does nothing else, and tell."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn) as pool:
        work = pool.submit(measure_one, config, request.device, request.rounds, skills)
        figures = work.result()
    rate, memory = figures["steps_per_second"], figures["memory_bytes"]
    request.tell(f"{name}: {rate:,.0f} env steps/s, {memory / 1e6:,.0f} MB")
    return figures


def measure_one(config: Config, device: str, rounds: int, skills: int | None = None) -> Figures:
    """Time control steps of one environment, and take what memory it needs.

    Args:
        config: Of one phase.
        device: Where it runs.
        rounds: That are measured, each a rollout long.
        skills: Keyframes, if not as many as the robot has.
    """
    robot = load_robot(config.robot)
    before = available_memory(device) if device != "cpu" else -_resident()
    with single_threaded(device):
        env = make_env(config, device, robot=with_skills(robot, skills) if skills else robot)
        work = Workload(env, config.sim, config.learner.ppo.num_steps, config.seed)
        run = work.environment()
        seconds = median([run() for _ in range(rounds + 1)][1:])
    after = available_memory(device) if device != "cpu" else -_resident()
    return {
        "worlds": config.num_envs,
        "skills": len(env.skills),
        "seconds_per_step": seconds,
        "steps_per_second": config.num_envs / seconds,
        "memory_bytes": before - after,
    }


def with_skills(robot: Robot, count: int) -> Robot:
    """Return the robot with `count` keyframes: its own, again and again."""
    frames = itertools.cycle(robot.keyframes)
    return replace(
        robot,
        keyframes=tuple(
            replace(frame, name=f"{frame.name}_{k}")
            for k, frame in enumerate(itertools.islice(frames, count))
        ),
    )


def available_memory(device: str) -> int:
    """Return what a process could still take, bytes: torch and Warp share what a GPU has."""
    if torch.device(device).type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    lines = Path("/proc/meminfo").read_text("utf-8").splitlines()
    (line,) = (line for line in lines if line.startswith("MemAvailable:"))
    return 1024 * int(line.split()[1])


def _resident() -> int:
    """Return the memory that this process holds, bytes."""
    pages = int(Path("/proc/self/statm").read_text("utf-8").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def table(figures: Figures) -> list[Table]:
    """Return speed and memory against worlds, and the cost of what is in them."""
    where = f"{figures['robot']}, {figures['backend']} on {figures['device']}"
    columns = ("ms a step", "env steps/s", "us a world", "MB", "kB a further world")
    sizes = make_table(f"environments of many worlds: {where}", *columns)
    for index, size in enumerate(figures["sizes"]):
        before = figures["sizes"][index - 1] if index else None
        sizes.add_row(f"{size['worlds']:,} worlds", *_row(size), _memory_of_a_world(size, before))
    sizes.caption = f"stopped: {figures['stopped']}" if figures["stopped"] else None
    if not figures["variants"]:
        return [sizes]
    variants = make_table(f"{figures['worlds']:,} worlds: {where}", *columns[:-1], "times flat")
    flat = figures["variants"][FLAT]["seconds_per_step"]
    for name, size in figures["variants"].items():
        variants.add_row(name, *_row(size), f"{size['seconds_per_step'] / flat:.2f}")
    return [sizes, variants]


def _row(size: Figures) -> tuple[str, ...]:
    seconds, worlds = size["seconds_per_step"], size["worlds"]
    return (
        f"{1e3 * seconds:.2f}",
        f"{size['steps_per_second']:,.0f}",
        f"{1e6 * seconds / worlds:.2f}",
        f"{size['memory_bytes'] / 1e6:.0f}",
    )


def _memory_of_a_world(size: Figures, before: Figures | None) -> str:
    """Return what each world more than in the row before takes: what all share is not counted."""
    if before is None or before["worlds"] == size["worlds"]:
        return ""
    grown = size["memory_bytes"] - before["memory_bytes"]
    return f"{grown / (size['worlds'] - before['worlds']) / 1e3:.1f}"


def plot(figures: Figures) -> Figure:
    """Return speed and memory against worlds."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    speed, memory = figure.subplots(1, 2)
    worlds = [size["worlds"] for size in figures["sizes"]]
    rates = [size["steps_per_second"] for size in figures["sizes"]]
    megabytes = [size["memory_bytes"] / 1e6 for size in figures["sizes"]]
    for axes, values, label in (
        (speed, rates, "environment steps / s"),
        (memory, megabytes, "memory (MB)"),
    ):
        axes.plot(worlds, values, marker="o")
        axes.set_ylim(0.0, 1.1 * max(values))
        axes.set_ylabel(label)
        axes.set_xscale("log", base=2)
        axes.set_xticks(worlds)
        axes.xaxis.set_major_formatter(ScalarFormatter())
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.tick_params(axis="x", labelrotation=30)
        axes.set_xlabel("worlds")
        axes.grid(alpha=0.3)
    figure.suptitle(f"{figures['robot']}, {figures['backend']} on {figures['device']}")
    return figure
