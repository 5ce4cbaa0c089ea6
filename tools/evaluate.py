"""kiras-evaluate: measure a policy by fixed protocols."""

from __future__ import annotations

import argparse
import copy
import json
import math
import sys
from dataclasses import asdict
from pathlib import Path

from rich.console import Console

from kiras_rl.checkpoint import CheckpointError
from kiras_rl.config import ConfigError
from kiras_rl.deploy.metadata import PolicyError
from kiras_rl.envs.terrain_library import build_library
from kiras_rl.evaluation.flat import SETTLE, Policy, SkillResult, evaluate_skills
from kiras_rl.evaluation.imitation import STEPS, evaluate_imitation
from kiras_rl.evaluation.terrain import TIME_LIMIT, evaluate_terrain, rough_types
from kiras_rl.evaluation.transitions import evaluate_transitions
from kiras_rl.phases import FINETUNING, SKILL_LEARNING, phase_config
from kiras_rl.robots.robot import RobotError, load_robot
from kiras_rl.schema import Config
from kiras_rl.tools.evaluator import (
    FLOOR,
    evaluation_physics,
    make_evaluation_env,
    onboard_policy,
    trained_config,
)
from kiras_rl.tools.policy_files import load_policy
from kiras_rl.tools.tables import (
    imitation_tables,
    results_table,
    terrain_table,
    transitions_table,
)

DESCRIPTION = """\
Measure a policy without action noise, on robots drawn by the paper's domain randomization, with
sensor noise, actuation delay and pushes.

Without --protocol: flat, imitation, transitions and, for a policy that was finetuned, terrain.

flat         every skill walks straight ahead for 20 s; height and pitch errors are those of a 0.4 s
             moving average after the first second, the velocity error is that of each step
imitation    every skill walks straight ahead, without pushes; of the 120 steps after the first
             second: distance (dynamic time warping) and cosine to the keyframe, errors of height
             and pitch, the nearest keyframe; foot clearance, stepping, torques, power
transitions  every ordered pair of skills, switched while walking: falls, and time until the moving
             averages of height (1.5 cm) and pitch (3 degrees) stay at the new keyframe for 0.3 s;
             a robot that was not in the first skill before the switch counts as not settled
terrain      every skill crosses every rough terrain type at several levels of difficulty, 0 the
             lowest and 10 the top: from the middle of a tile, with any heading, which is held, at
             0.2 to 0.6 m/s, 3 m far within twice the time of the way and 20 s, without a fall;
             strictly, if thighs and shanks touch the ground in at most 5 % of the steps
"""

EXAMPLES = """\
examples:
  kiras-evaluate                              the policy shipped with Solo-8
  kiras-evaluate runs/solo8_quick/2026-01-31_12-00-00
  kiras-evaluate policy.onnx --protocol imitation --json imitation.json
  kiras-evaluate policy.onnx --protocol transitions --trials 50 --json transitions.json
  kiras-evaluate policy.onnx --protocol terrain --levels 4,5 --trials 100
"""

PROTOCOLS = ("all", "flat", "imitation", "transitions", "terrain")

LEVELS = 11
"""Of the terrain protocol, whatever the training had: steps of a tenth from lowest to top."""

SPEEDS = (0.2, 0.6)
"""Commanded v_x of the terrain protocol, m/s."""

console = Console()


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    args = _parse(argv)
    try:
        report = evaluate(args)
    except (ConfigError, CheckpointError, PolicyError, RobotError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if args.json:
        args.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    return 0


def _parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="kiras-evaluate",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("policy", nargs="?", type=Path, help="run folder, checkpoint or ONNX file")
    parser.add_argument("--robot", help="whose shipped policy, if none is given (solo8)")
    parser.add_argument("--protocol", choices=PROTOCOLS, default="all")
    parser.add_argument(
        "--robots", type=_count, default=100, help="robots a skill (flat, imitation)"
    )
    parser.add_argument("--duration", type=float, default=20.0, help="s a robot (flat)")
    parser.add_argument(
        "--trials", type=_count, default=50, help="of a pair (transitions), or of a cell (terrain)"
    )
    parser.add_argument(
        "--levels", type=_levels, default="0,2,4,6,8,10", help="of terrain, 0 to 10"
    )
    parser.add_argument("--command", type=float, default=0.3, help="v_x, m/s")
    parser.add_argument("--nominal", action="store_true", help="no randomization, noise or pushes")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    return parser.parse_args(argv)


def evaluate(args: argparse.Namespace) -> dict:
    """Run the protocols, print tables and return all figures."""
    onboard = load_policy(args.policy, args.robot)
    metadata, policy = onboard.metadata, onboard_policy(onboard)
    whole = trained_config(metadata)
    config = evaluation_physics(phase_config(whole, SKILL_LEARNING), args.nominal)
    skills = len(metadata.skills)
    report: dict = {"provenance": metadata.provenance, "command": args.command}
    if args.protocol in ("all", "flat"):
        env = make_evaluation_env(config, args.robots * skills, args.duration)
        results = evaluate_skills(env, policy, args.duration, args.command)
        console.print(results_table(results, f"flat: {args.robots} robots a skill"))
        report["flat"] = {name: asdict(result) for name, result in results.items()}
        _verdict(results)
    if args.protocol in ("all", "imitation"):
        report["imitation"] = _imitation(config, policy, skills, args)
    if args.protocol in ("all", "transitions"):
        report["transitions"] = _transitions(config, policy, skills, args)
    finetuned = metadata.provenance.get("iterations", 0) > whole.iterations
    if args.protocol == "terrain" or (args.protocol == "all" and finetuned):
        rough = evaluation_physics(phase_config(whole, FINETUNING), args.nominal)
        report["terrain"] = _terrain(rough, policy, args)
    return report


def _imitation(config: Config, policy: Policy, skills: int, args: argparse.Namespace) -> dict:
    config = copy.deepcopy(config)
    config.env.randomization.push_velocity = None
    duration = SETTLE + STEPS * config.sim.timestep * config.sim.substeps
    env = make_evaluation_env(config, args.robots * skills, duration)
    result = evaluate_imitation(env, policy, args.command)
    for table in imitation_tables(result, args.robots):
        console.print(table)
    return result.as_dict()


def _count(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"'{text}': give a number of at least 1")
    return int(text)


def _levels(text: str) -> list[int]:
    levels = [int(part) for part in text.split(",") if part.isdigit()]
    if len(levels) != text.count(",") + 1 or max(levels) >= LEVELS:
        raise argparse.ArgumentTypeError(f"'{text}': give levels from 0 to {LEVELS - 1}, as in 4,5")
    return levels


def _terrain(config: Config, policy: Policy, args: argparse.Namespace) -> dict:
    """Try every skill on every rough type at every level, one level after the other."""
    if config.env.terrain is None:
        raise ConfigError("this policy's configuration has no terrain: finetuning=null in its run")
    config.env.terrain.levels = LEVELS
    skills = load_robot(config.robot).skills
    count = len(rough_types(build_library(config.env.terrain).types))
    env = make_evaluation_env(config, args.trials * count * len(skills), TIME_LIMIT)
    report = {}
    for level in args.levels:
        result = evaluate_terrain(env, policy, args.trials, level, SPEEDS)
        console.print(terrain_table(result))
        report[str(level)] = {
            "terrains": result.terrains,
            "skills": result.skills,
            "success": result.success.tolist(),
            "strict": result.strict.tolist(),
        }
    return report


def _verdict(results: dict[str, SkillResult]) -> None:
    target = {"height": 0.01, "pitch": math.radians(2.0), "velocity": 0.08, "falls": 0.0}
    for name, limits in (("floor", FLOOR), ("target", target)):
        met = [skill for skill, result in results.items() if result.meets(**limits)]
        console.print(f"{name}: {len(met)} of {len(results)} skills ({', '.join(met) or 'none'})")


def _transitions(config: Config, policy: Policy, skills: int, args: argparse.Namespace) -> dict:
    worlds = skills * (skills - 1) * args.trials
    env = make_evaluation_env(config, worlds, 10.0)
    result = evaluate_transitions(env, policy, args.trials, args.command)
    console.print(transitions_table(result, env.skills))
    fell, settled = result.overall()
    console.print(f"falls {100 * fell:.1f} %, settled within 2 s {100 * settled:.1f} %")
    return {
        "skills": list(env.skills),
        "fell": result.fell.nan_to_num().tolist(),
        "settled": result.settled.nan_to_num().tolist(),
        "settle_time": result.settle_time.nan_to_num().tolist(),
        "overall": {"fell": fell, "settled": settled},
    }


if __name__ == "__main__":
    sys.exit(main())
