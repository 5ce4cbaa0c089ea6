"""kiras-train: train a robot's skills."""

from __future__ import annotations

import argparse
import datetime
import logging
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import torch
from rich.console import Console

from kiras_rl import checkpoint
from kiras_rl.checkpoint import CheckpointError
from kiras_rl.config import (
    ConfigError,
    check_resume_overrides,
    config_from_dict,
    list_configs,
    load_config,
    save_config,
)
from kiras_rl.deploy.policy import OnboardPolicy, PolicyError, PolicyMetadata
from kiras_rl.envs import make_env, resolve_backend
from kiras_rl.export import ExportError, export_policy
from kiras_rl.phases import (
    FINETUNING,
    SKILL_LEARNING,
    phase_config,
    phases_of,
    total_iterations,
)
from kiras_rl.robots.robot import RobotError
from kiras_rl.runner import KirasRunner, TrainingError
from kiras_rl.schema import Config
from kiras_rl.tools.curves import draw_curves
from kiras_rl.tools.evaluator import check_terrain, make_evaluators, onboard_policy
from kiras_rl.tools.progress import Progress
from kiras_rl.tools.tables import results_table, terrain_table

DESCRIPTION = """\
Train one policy for all skills of a robot.

A configuration is a file of cfg/ (give its name) or a YAML file of your own (give its path); any
key can be set on the command line. Every key is explained in cfg/base.yaml.

A run lives in runs/<configuration>/<time>/: config.yaml, checkpoints/, the TensorBoard log,
policy.onnx and curves.png. Ctrl-C stops after the current iteration and saves; --resume goes on
exactly where it stopped.
"""

EXAMPLES = """\
examples:
  kiras-train --cfg solo8_quick                       ten minutes on two CPU cores
  kiras-train --cfg solo8 num_envs=2048 seed=2        set keys
  kiras-train --cfg ablations/no_sil iterations=300   a part of the method left out
  kiras-train --cfg mine.yaml                         your own file, with "extends: solo8"
  kiras-train --resume runs/solo8/2026-01-31_12-00-00
  tensorboard --logdir runs
"""

console = Console()

MISTAKES = (CheckpointError, ConfigError, ExportError, PolicyError, RobotError, TrainingError)
"""Errors whose message is all that a user needs."""


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    args = _parse(argv)
    logging.basicConfig(format="%(message)s")
    logging.getLogger("kiras_rl").setLevel(logging.INFO)  # "kernels compile": minutes, once
    try:
        return train(args.cfg, args.resume, args.overrides, args.runs)
    except MISTAKES as error:
        print(f"error: {error}", file=sys.stderr)
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
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="where runs are written")
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="keys to set")
    return parser.parse_intermixed_args(argv)


def train(cfg: str | None, resume: Path | None, overrides: list[str], runs: Path) -> int:
    """Train a new run or go on with an old one; return the exit code."""
    phase, source = SKILL_LEARNING, None
    if resume is not None:
        check_resume_overrides(overrides)
        source = checkpoint.find_checkpoint(resume, prefer=checkpoint.LATEST)
        run_dir = _run_of(source)
        saved = checkpoint.load_checkpoint(source)
        config, phase = config_from_dict(saved["config"], overrides), saved["phase"]
    else:
        assert cfg is not None
        config = load_config(cfg, overrides)
        run_dir = _new_run_dir(runs, cfg)
    _check(config)
    runner = _build(config, run_dir, phase)
    if source is not None:
        runner.load(str(source))
    else:
        runner.run_dir = run_dir = claim(run_dir)
    save_config(config, run_dir / "config.yaml")
    _announce(config, runner, run_dir, source)
    with Progress(console) as progress:
        finished = runner.learn(on_iteration=progress.show)
        if finished and phase == SKILL_LEARNING and config.finetuning:
            runner = _next_phase(runner)
            finished = runner.learn(on_iteration=progress.show)
    if not finished:
        message = f"stopped and saved; go on with: kiras-train --resume {run_dir}"
        console.print(message, highlight=False, soft_wrap=True)
        return 0
    _conclude(runner, run_dir)
    return 0


def _check(config: Config) -> None:
    """Refuse now what a later phase could not use, not after hours of training."""
    if config.finetuning:
        check_terrain(config)


def _next_phase(before: KirasRunner) -> KirasRunner:
    """Return the learner of terrain finetuning, which begins where skill learning ended.

    The best policy of skill learning stays in the run under a name of its own.
    """
    config, run_dir = before.config, before.run_dir
    assert run_dir is not None
    folder = run_dir / checkpoint.FOLDER
    runner = _build(config, run_dir, FINETUNING)
    runner.begin_from(folder / checkpoint.LATEST)
    with suppress(FileNotFoundError):
        (folder / checkpoint.BEST).replace(folder / checkpoint.FLAT)
    return runner


def _new_run_dir(runs: Path, cfg: str) -> Path:
    name = cfg.removesuffix(".yaml") if not Path(cfg).is_file() else Path(cfg).stem
    stamp = datetime.datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    return runs / name / stamp


def claim(folder: Path) -> Path:
    """Make a new folder; where one is there, of a run begun in the same second, add a number."""
    name, number = folder.name, 1
    while True:
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:
            number += 1
            folder = folder.with_name(f"{name}.{number}")


def _run_of(source: Path) -> Path:
    if source.absolute().parent.name != checkpoint.FOLDER:
        raise CheckpointError(
            f"{source} lies in no run: give the run folder, or a file in its {checkpoint.FOLDER}/"
        )
    return source.absolute().parent.parent


def _build(config: Config, run_dir: Path, phase: str) -> KirasRunner:
    device = resolve_device(config.device)
    env = make_env(phase_config(config, phase), device)
    evaluators = make_evaluators(config, phase, device)
    runner = KirasRunner(env, config, run_dir, device, evaluators, _source_commit(), phase)
    # What could not be exported is refused now, not after hours of training.
    PolicyMetadata.from_dict(runner.describe_policy())
    return runner


def _source_commit() -> str:
    """Return the commit of the checkout that runs, or "unknown" for an installed package."""
    folder = Path(__file__).resolve().parents[1]
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def resolve_device(name: str) -> str:
    """Return "cpu" or a CUDA device.

    Raises:
        ConfigError: CUDA asked for where there is none, or an unknown name.
    """
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if name.split(":")[0] not in ("cpu", "cuda"):
        raise ConfigError(f"device={name}: allowed are auto, cpu, cuda")
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise ConfigError(f"device={name}: torch finds no CUDA device here; set device=cpu")
    return name


def _announce(config: Config, runner: KirasRunner, run_dir: Path, source: Path | None) -> None:
    backend = resolve_backend(config.sim.backend, torch.device(runner.device))
    steps = config.num_envs * config.learner.ppo.num_steps * total_iterations(config)
    verb = f"resuming at iteration {runner.current_learning_iteration}" if source else "training"
    console.print(
        f"[bold]{config.robot}[/]: {verb}, {', '.join(runner.env.skills)} | "
        f"{config.num_envs} worlds, {backend} physics, {runner.device} | "
        f"{' + '.join(map(str, _lengths(config)))} iterations, {steps / 1e6:.1f} M steps | "
        f"{run_dir}",
        highlight=False,
        soft_wrap=True,
    )


def _lengths(config: Config) -> list[int]:
    return [phase_config(config, phase).iterations for phase in phases_of(config)]


def _conclude(runner: KirasRunner, run_dir: Path) -> None:
    """Export the best policy, draw the curves, and say what there is and what to type next."""
    best = checkpoint.find_checkpoint(run_dir)
    onnx = export_policy(*checkpoint.load_policy(best), run_dir / "policy.onnx").path
    curves = draw_curves(run_dir)
    evaluators, policy = runner.evaluators, onboard_policy(OnboardPolicy(onnx))
    if evaluators.flat:
        results = evaluators.flat(policy)
        console.print(results_table(results, "best policy, without action noise, v_x = 0.3 m/s"))
    if evaluators.terrain:
        console.print(terrain_table(evaluators.terrain(policy)))
    console.print(
        f"{runner.seconds / 60:.1f} min of training\n"
        f"checkpoint  {best}\nONNX        {onnx}\ncurves      {curves}\n"
        f"next:       kiras-play {run_dir} --trace trace.png\n"
        f"            tensorboard --logdir {run_dir}",
        highlight=False,
        soft_wrap=True,
    )


if __name__ == "__main__":
    sys.exit(main())
