"""kiras-collect: record what a policy does as a dataset."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.table import Table

from kiras_rl.checkpoint import versions
from kiras_rl.config import ConfigError
from kiras_rl.dataset import FORMATS, Dataset, check_target, save_dataset
from kiras_rl.deploy.policy import PolicyError, PolicyMetadata
from kiras_rl.phases import plan
from kiras_rl.schema import Config
from kiras_rl.tools.driving.collector import Plan, Range, collect
from kiras_rl.tools.driving.ground import Terrain
from kiras_rl.tools.evaluation.evaluator import (
    evaluation_physics,
    make_evaluation_env,
    onboard_policy,
    trained_config,
)
from kiras_rl.tools.shared.arguments import at_least, seconds_above
from kiras_rl.tools.shared.console import make_console
from kiras_rl.tools.shared.ending import finish
from kiras_rl.tools.shared.policy_files import load_policy, robot_of

DESCRIPTION = """\
Record episodes of a policy, without action noise, as a dataset: base, joints, torques, contacts,
imitation features, commands and actions of every control step, with names and units.

The robots are drawn as kiras-evaluate draws them, by the paper's domain randomization, with sensor
noise, actuation delay and pushes; what is recorded is what they did, without sensor noise. Each
episode has a command of its own. It ends after --duration, at a fall or, on terrain, where the
robot is 3.7 m from its start along x or y, the edge of a tile.
"""

EXAMPLES = """\
examples:
  kiras-collect --out walks                           the policy shipped with Solo-8
  kiras-collect runs/solo8_quick/2026-01-31_12-00-00 --skills walk,crawl --command 0.1:0.5 --out a
  kiras-collect policy.onnx --nominal --format lerobot --out b
  kiras-collect policy.onnx --terrain stairs_up:4 --command=0.2:0.6 --out c

then, in Python:
  dataset = kiras_rl.dataset.load_dataset("walks")
"""

"""Errors whose message is all that a user needs."""

MANY = ("npz", "lerobot", "both")

console = make_console()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    args = _parse(argv)
    line = shlex.join(["kiras-collect", *(sys.argv[1:] if argv is None else argv)])

    def work() -> None:
        dataset = _collect(args, line)
        console.print(_summary(dataset, args.episodes))
        console.print(f"{args.out}: {len(dataset)} frames at {dataset.rate:g} Hz", soft_wrap=True)

    return finish(work, stopped="interrupted: nothing was written")


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="kiras-collect",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("policy", nargs="?", type=Path, help="run folder, checkpoint or ONNX file")
    parser.add_argument("--robot", help="whose shipped policy, if none is given (solo8)")
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="new folder")
    parser.add_argument("--format", choices=MANY, default="npz", help="of the dataset (npz)")
    parser.add_argument("--skills", metavar="NAME,...", help="of the policy (all)")
    parser.add_argument("--episodes", type=at_least(1), default=10, help="of each skill (10)")
    parser.add_argument(
        "--duration", type=seconds_above(0), default=10.0, help="of an episode, s (10)"
    )
    parser.add_argument(
        "--command",
        type=_command,
        default="0.3",
        metavar="V_X[,V_Y[,YAW]]",
        help="m/s, m/s, rad/s; each a number or a range LOW:HIGH to draw from (0.3)",
    )
    parser.add_argument("--seed", type=at_least(0), default=0, help="of robots and commands (0)")
    parser.add_argument("--nominal", action="store_true", help="no randomization, noise or pushes")
    parser.add_argument(
        "--terrain", default="flat", metavar="TYPE[:LEVEL]", help="the heading is held there (flat)"
    )
    return parser.parse_args(argv)


def _collect(args: argparse.Namespace, line: str) -> Dataset:
    formats = FORMATS if args.format == "both" else (args.format,)
    check_target(args.out, formats)  # not after minutes of physics
    onboard = load_policy(args.policy, args.robot)
    metadata = onboard.metadata
    skills = _skills(args.skills, metadata)
    config, terrain = _ground(trained_config(metadata), args.terrain)
    config = evaluation_physics(config, args.nominal)
    plan = Plan(skills, args.episodes, args.duration, args.command, args.seed, terrain)
    env = make_evaluation_env(config, plan.num_envs, plan.duration, robot=robot_of(metadata))
    dataset = collect(env, onboard_policy(onboard), plan, _provenance(args, metadata, line))
    save_dataset(dataset, args.out, formats)
    return dataset


def _skills(text: str | None, metadata: PolicyMetadata) -> tuple[str, ...]:
    if text is None:
        return metadata.skills
    skills = tuple(dict.fromkeys(text.split(",")))
    unknown = [name for name in skills if name not in metadata.skills]
    if unknown:
        raise PolicyError(
            f"unknown skill '{unknown[0]}' in --skills; this policy has: "
            f"{', '.join(metadata.skills)}"
        )
    return skills


def _ground(whole: Config, text: str) -> tuple[Config, tuple[str, int] | None]:
    """Return the configuration of the phase that has the ground, and its type and level."""
    phases = plan(whole)
    if text == "flat":
        return phases[0].config, None
    config = phases[-1].config
    if config.env.terrain is None:
        raise ConfigError("this policy's configuration has no terrain: finetuning=null in its run")
    if text.count(":") > 1:
        raise ConfigError(
            f"--terrain {text}: give TYPE[:LEVEL]; variants are dealt to the episodes in turn"
        )
    tile = Terrain(config.env.terrain).parse(text)
    return config, (tile.kind, tile.level)


def _provenance(args: argparse.Namespace, metadata: PolicyMetadata, line: str) -> dict:
    return {
        "command_line": line,
        "policy": {"version": metadata.version, **metadata.provenance},
        "options": {name: value for name, value in vars(args).items() if name != "out"},
        "versions": versions(),
    }


def _summary(dataset: Dataset, episodes: int) -> Table:
    table = Table("skill")
    for column in ("episodes", "frames", "falls", "mean v_x\nm/s"):
        table.add_column(column, justify="right")
    for index, skill in enumerate(dataset.skills):
        mine = dataset.skill == index
        speed = dataset["base_lin_vel_h"][mine, 0]
        table.add_row(
            skill,
            f"{dataset.done[mine].sum()} of {episodes}",
            str(mine.sum()),
            str(dataset.fallen[mine].sum()),
            f"{speed.mean():+.2f}" if len(speed) else "",
        )
    return table


def _command(text: str) -> tuple[Range, ...]:
    """Read `V_X[,V_Y[,YAW_RATE]]`, each a number or LOW:HIGH; what is left out is zero."""
    try:
        ranges = [[float(x) for x in part.split(":")] for part in text.split(",")]
        pairs = [(low, high) for low, high in (2 * r if len(r) == 1 else r for r in ranges)]
    except ValueError:
        pairs = []
    if not 1 <= len(pairs) <= 3 or not np.isfinite(pairs).all() or any(a > b for a, b in pairs):
        raise argparse.ArgumentTypeError(
            f"'{text}': give v_x[,v_y[,yaw_rate]], each a number or LOW:HIGH, as in 0.1:0.5,0,0.3"
        )
    return (*pairs, *(3 - len(pairs)) * [(0.0, 0.0)])


if __name__ == "__main__":
    sys.exit(main())
