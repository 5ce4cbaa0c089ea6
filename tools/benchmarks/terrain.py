"""What terrain costs: against MuJoCo alone on the same tiles, and against flat ground."""

from __future__ import annotations

from rich.table import Table

from kiras_rl.config import ConfigError
from kiras_rl.envs import make_env
from kiras_rl.phases import plan
from kiras_rl.process import single_threaded
from kiras_rl.tools.benchmarks.physics import ENVIRONMENT
from kiras_rl.tools.benchmarks.request import Figures, Request, native
from kiras_rl.tools.benchmarks.tables import make_table, verdict, with_range
from kiras_rl.tools.benchmarks.timing import interleave, ratios, summarise
from kiras_rl.tools.benchmarks.workload import Workload

BARE_TERRAIN, TERRAIN = "mujoco.batch on terrain", "environment step on terrain"
SPEED_TARGET = 0.75  # of bare mujoco.batch on the same terrain
COST_TARGET = 2.5  # times a step on flat ground


def measure(request: Request) -> Figures:
    """Time the environment of finetuning, its physics alone, and the one on flat ground.

    The worlds show the tiles with which finetuning begins. Native backend, one thread of torch.

    Raises:
        ConfigError: No finetuning, or as `make_env`.
        RobotError: As `make_env`.
    """
    config = native(request.config)
    if config.finetuning is None:
        raise ConfigError("finetuning=null: this configuration has no terrain to measure")
    with single_threaded("cpu"):
        flat, rough = (
            Workload(make_env(alone), alone.sim, alone.learner.ppo.num_steps, alone.seed)
            for alone in (phase.config for phase in plan(config))
        )
        variants = {
            ENVIRONMENT: flat.environment(),
            BARE_TERRAIN: rough.bare(),
            TERRAIN: rough.environment(),
        }
        steps = interleave(variants, request.rounds)
    return {
        "worlds": config.num_envs,
        "seconds_per_step": {name: summarise(times) for name, times in steps.items()},
        "share_of_bare_speed": summarise(ratios(steps, BARE_TERRAIN, TERRAIN)),
        "times_flat": summarise(ratios(steps, TERRAIN, ENVIRONMENT)),
        "targets": [SPEED_TARGET, COST_TARGET],
        "rounds": steps,
    }


def table(figures: Figures) -> list[Table]:
    """Return the comparison."""
    worlds, (least, most) = figures["worlds"], figures["targets"]
    share, cost = figures["share_of_bare_speed"], figures["times_flat"]
    columns = ("ms", "env steps/s", "of bare speed", "times flat ground")
    steps = make_table(f"control steps of {worlds} worlds", *columns)
    for name, seconds in figures["seconds_per_step"].items():
        row = [f"{1e3 * seconds['median']:.2f}", f"{worlds / seconds['median']:,.0f}"]
        if name == TERRAIN:
            row += ["{} ({})".format(*with_range(figure)) for figure in (share, cost)]
        steps.add_row(name, *row)
    fast, cheap = share["median"] >= least, cost["median"] <= most
    steps.caption = "\n".join(
        (
            verdict(fast, f"target: at least {least} of bare speed"),
            verdict(cheap, f"target: at most {most} times flat ground"),
        )
    )
    return [steps]
