"""How much of bare MuJoCo's speed is left in a step of the environment, and where the rest goes."""

from __future__ import annotations

from statistics import median

import torch
from rich.table import Table

from kiras_rl.envs import make_env, resolve_backend
from kiras_rl.process import single_threaded
from kiras_rl.tools.benchmarks.request import Figures, Request
from kiras_rl.tools.benchmarks.tables import make_table, verdict, with_range
from kiras_rl.tools.benchmarks.timing import PartTimer, Times, interleave, ratios, summarise
from kiras_rl.tools.benchmarks.workload import ENVIRONMENT_PARTS, Workload

BARE = {"native": "mujoco.batch", "warp": "mujoco_warp"}
NO_SENSORS, SIMULATION, ENVIRONMENT = "without sensors", "simulation step", "environment step"
TARGET = {"native": 0.8, "warp": 0.9}  # of the bare library's speed


def measure(request: Request) -> Figures:
    """Time the environment and what it is built on, with torch on one thread as in a rollout.

    Raises:
        ConfigError: As `make_env`.
        RobotError: As `make_env`.
    """
    config, rounds, device = request.config, request.rounds, request.device
    backend = resolve_backend(config.sim.backend, torch.device(device))
    bare = BARE[backend]
    with single_threaded(device):
        env = make_env(config, device)
        work = Workload(env, config.sim, config.learner.ppo.num_steps, config.seed)
        variants = {
            bare: work.bare(),
            f"{bare} {NO_SENSORS}": work.bare(sensors=False),
            SIMULATION: work.simulation(),
            ENVIRONMENT: work.environment(),
        }
        steps = interleave(variants, rounds)
        parts, resets = _measure_parts(work, rounds), _share_of_resets(work)
    return {
        "worlds": config.num_envs,
        "device": device,
        "seconds_per_step": {name: summarise(times) for name, times in steps.items()},
        "steps_per_second": {n: config.num_envs / median(times) for n, times in steps.items()},
        "share_of_bare_speed": {n: summarise(ratios(steps, bare, n)) for n in steps},
        "target": TARGET[backend],
        "share_of_worlds_reset": resets,
        "parts_seconds": {part: median(times) for part, times in parts.items()},
        "rounds": {"steps": steps, "parts": parts},
    }


def _measure_parts(work: Workload, rounds: int) -> Times:
    """Time the parts in rounds of their own: the clock's calls shall not slow the comparison.

    A part that no step ran is left out.
    """
    timer = PartTimer(work.env.device)
    timer.wrap_all(work.env, ENVIRONMENT_PARTS)
    parts: Times = {part: [] for part in timer.seconds}
    run = work.environment()
    for _ in range(rounds):
        timer.clear()
        run()
        for part, seconds in timer.seconds.items():
            parts[part].append(seconds / len(work.actions))
    timer.unwrap()
    return {part: times for part, times in parts.items() if any(times)}


def _share_of_resets(work: Workload) -> float:
    work.restore()
    ended = [work.env.step(action)[2].float().mean().item() for action in work.actions]
    return sum(ended) / len(ended)


def table(figures: Figures) -> list[Table]:
    """Return the comparison, and the parts of a step."""
    columns = ("ms", "env steps/s", "of bare speed", "range")
    title = f"control steps of {figures['worlds']} worlds on {figures['device']}"
    speeds = make_table(title, *columns)
    for name, seconds in figures["seconds_per_step"].items():
        ms, rate = f"{1e3 * seconds['median']:.2f}", f"{figures['steps_per_second'][name]:,.0f}"
        speeds.add_row(name, ms, rate, *with_range(figures["share_of_bare_speed"][name]))
    reached = figures["share_of_bare_speed"][ENVIRONMENT]["median"]
    speeds.caption = verdict(reached >= figures["target"], f"target: at least {figures['target']}")
    return [speeds, _parts_of_a_step(figures)]


def _parts_of_a_step(figures: Figures) -> Table:
    seconds = figures["parts_seconds"]
    whole = sum(seconds.values())
    resets = 100 * figures["share_of_worlds_reset"]
    parts = make_table(f"one environment step ({resets:.1f} % of the worlds reset)", "ms", "%")
    for part, value in seconds.items():
        parts.add_row(part, f"{1e3 * value:.2f}", f"{100 * value / whole:.1f}")
    return parts
