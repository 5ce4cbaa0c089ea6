"""One run: its learner, its two phases, and what it leaves behind."""

from __future__ import annotations

import copy
import re
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path

import torch
from rich.text import Text

from kiras_rl import checkpoint, distributed
from kiras_rl.checkpoint import CheckpointError
from kiras_rl.config import ConfigError, check_resume_overrides, config_from_dict, save_config
from kiras_rl.deploy.policy import OnboardPolicy, PolicyError, PolicyMetadata
from kiras_rl.envs import make_env, resolve_backend
from kiras_rl.export import export_policy
from kiras_rl.files import remove_leftovers
from kiras_rl.ownership import owning
from kiras_rl.phases import (
    FINETUNING,
    SKILL_LEARNING,
    Phase,
    phase_of,
    plan,
)
from kiras_rl.process import StopRequest
from kiras_rl.runner import KirasRunner
from kiras_rl.schema import Config
from kiras_rl.tools.evaluation.evaluator import check_terrain, make_evaluators, onboard_policy
from kiras_rl.tools.evaluation.protocols import flat, terrain
from kiras_rl.tools.evaluation.report.terminal import as_rich
from kiras_rl.tools.shared.console import make_console
from kiras_rl.tools.shared.ending import is_out_of_memory, one_line
from kiras_rl.tools.shared.source import source_commit
from kiras_rl.tools.training.curves import draw_curves
from kiras_rl.tools.training.flat_policy import check_fit, read_flat, sizes
from kiras_rl.tools.training.progress import Progress

CONFIG, POLICY = "config.yaml", "policy.onnx"
"""Files of a run; the second one is the last that is written."""

console = make_console()


def message_of(error: Exception) -> str:
    """Return the one line that a user reads of a mistake."""
    if is_out_of_memory(error):
        return f"not enough memory ({one_line(error)}): fewer worlds need less, lower num_envs"
    return one_line(error)


# --- a learner -----------------------------------------------------------------------------------


def begin(config: Config, flat: Path | None = None) -> KirasRunner:
    """Return the learner of a new run, which has no folder yet.

    Args:
        config: The run.
        flat: Checkpoint of an earlier skill learning, with whose best policy finetuning begins;
            None to learn the skills first.

    Raises:
        CheckpointError: A checkpoint that does not fit.
        ConfigError: What this phase or a later one could not use.
    """
    content = distributed.from_main(lambda: read_flat(flat, config)) if flat else None
    check(config)
    runner = build(phase_of(config, FINETUNING if flat else SKILL_LEARNING), None)
    if flat and content:
        check_fit(flat, content, runner)
        runner.begin_from(flat)
        runner.begun_from = str(flat)
    return runner


def resume(source: Path, overrides: list[str], changed_robot: bool = False) -> KirasRunner:
    """Return the learner of a run that goes on from one of its checkpoints.

    Args:
        source: The checkpoint.
        overrides: `key=value` strings for the keys that may change.
        changed_robot: Go on with the robot of today though its files have changed.

    Own its folder meanwhile (`owning`): another process may write a newer one.

    Raises:
        CheckpointError: Unusable file, or one outside of a run.
        ConfigError: A key that may not change.
    """
    check_resume_overrides(overrides)
    run_dir, (values, phase) = run_of(source), distributed.from_main(lambda: _read_run(source))
    config = config_from_dict(values, overrides)
    if phase == FINETUNING and config.iterations != values["iterations"]:
        raise ConfigError(
            f"iterations={config.iterations}: the skill learning of this run is over, after "
            f"{values['iterations']}; finetuning.iterations may change"
        )
    if phase == SKILL_LEARNING:
        check(config)
    runner = build(phase_of(config, phase), run_dir)
    runner.takes_changed_robot = changed_robot
    runner.load(str(source))
    return runner


def _read_run(source: Path) -> tuple[dict, str]:
    saved = checkpoint.load_checkpoint(source)
    return saved["config"], saved["phase"]


def check(config: Config) -> None:
    """Refuse now what a later phase could not use, not after hours of training.

    Raises:
        ConfigError: Terrain, terms or networks of finetuning that cannot be.
    """
    if config.finetuning is None:
        return
    check_terrain(config)
    skill_learning, finetuning = plan(config)
    backend = finetuning.config.sim.backend
    resolve_backend(backend, torch.device(resolve_device(config.device)))
    before = networks_of(skill_learning)
    try:
        after = networks_of(finetuning)
    except (ConfigError, PolicyError) as error:
        raise ConfigError(f"finetuning: {error}") from None
    for name, shapes in before.items():
        if after.get(name) != shapes:
            raise ConfigError(
                f"finetuning: other {name} than in skill learning, which it goes on from: leave "
                "finetuning.learner and finetuning.env.observations without what changes them"
            )


def networks_of(phase: Phase) -> dict[str, list[tuple[int, ...]]]:
    """Return the shapes of the weights of a phase's networks; it is tried out with one world."""
    trial = copy.deepcopy(phase.config)
    trial.device, trial.sim.backend, trial.evaluation.interval = "cpu", "auto", 0
    return sizes(build(replace(phase, config=trial), None, num_envs=1).alg.networks())


def run_of(source: Path) -> Path:
    """Return the run folder that a checkpoint lies in.

    Raises:
        CheckpointError: It lies in none.
    """
    if source.absolute().parent.name != checkpoint.FOLDER:
        raise CheckpointError(
            f"{source} lies in no run: give the run folder, or a file in its {checkpoint.FOLDER}/"
        )
    return source.absolute().parent.parent


def build(phase: Phase, run_dir: Path | None, num_envs: int | None = None) -> KirasRunner:
    """Build the learner of a phase with its environment and evaluations.

    Args:
        phase: The phase.
        run_dir: Folder of the run.
        num_envs: Worlds, if not the configuration's.

    Raises:
        ConfigError: What the phase could not use.
        PolicyError: A policy that could not be exported.
    """
    device = resolve_device(phase.config.device)
    alone = copy.deepcopy(phase.config)
    alone.seed += distributed.rank()  # every rank has worlds of its own, and its share of the cores
    alone.sim.threads = alone.sim.threads or distributed.core_share()
    env = make_env(alone, device, num_envs, progress=0.0)
    evaluators = make_evaluators(phase, device)
    runner = KirasRunner(env, phase, run_dir, device, evaluators, source_commit())
    # What could not be exported is refused now, not after hours of training.
    PolicyMetadata.from_dict(runner.describe_policy())
    return runner


def resolve_device(name: str) -> str:
    """Return "cpu" or a CUDA device; of several ranks each has its own.

    Raises:
        ConfigError: CUDA asked for where there is none, or too little for the ranks, or an
            unknown name.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if not re.fullmatch(r"cpu|cuda(:\d+)?", name):
        raise ConfigError(f"device={name}: allowed are auto, cpu, cuda, cuda:N")
    if name == "cpu":
        return name
    if not torch.cuda.is_available():
        raise ConfigError(f"device={name}: torch finds no CUDA device here; set device=cpu")
    return _device_of_rank(name) if distributed.size() > 1 else _current_device(name)


def _current_device(name: str) -> str:
    """Make a CUDA device the current one: graphs and random numbers are those of that one."""
    index, devices = torch.device(name).index or 0, torch.cuda.device_count()
    if index >= devices:
        raise ConfigError(f"device={name}: there are cuda:0 to cuda:{devices - 1} here")
    torch.cuda.set_device(index)
    return name


def _device_of_rank(name: str) -> str:
    if name != "cuda":
        raise ConfigError(f"device={name}: each rank takes a GPU of its own; set device=cuda")
    ranks, devices = distributed.local_size(), torch.cuda.device_count()
    if ranks > devices:
        raise ConfigError(
            f"{ranks} ranks on a machine with {devices} CUDA device(s): start at most as many with "
            "torchrun --nproc-per-node, or set device=cpu"
        )
    return f"cuda:{distributed.local_rank()}"


# --- its training --------------------------------------------------------------------------------


def train_run(runner: KirasRunner, stop: StopRequest) -> bool:
    """Train a run in its folder, from where its learner stands to its end.

    Args:
        runner: What `begin` or `resume` returned, with a folder.
        stop: Asked to, the training ends after its iteration, and is saved.

    Returns:
        Whether the run came to its end.
    """
    assert runner.run_dir is not None
    with owning(runner.run_dir), _telling_what_is_left(runner.run_dir):
        return _train_owned(runner, stop)


def _train_owned(runner: KirasRunner, stop: StopRequest) -> bool:
    distributed.from_main(lambda: _begin_folder(runner))
    _announce(runner)
    with Progress(console) as progress:
        finished = runner.learn(on_iteration=progress.show, stop=stop)
        for phase in plan(runner.config):
            if finished and phase.first >= runner.phase.last:
                runner = _next_phase(runner, phase)
                finished = runner.learn(on_iteration=progress.show, stop=stop)
    if finished:
        distributed.from_main(lambda: _conclude(runner))
    return finished


@contextmanager
def _telling_what_is_left(run_dir: Path) -> Iterator[None]:
    """Note on whatever ends a training before its time from where it goes on."""
    try:
        yield
    except BaseException as error:
        latest = run_dir / checkpoint.FOLDER / checkpoint.LATEST
        again = f"go on with: kiras-train --resume {shlex.quote(str(run_dir))}"
        whole = f"{latest} is whole, {again}" if latest.is_file() else "there is no checkpoint yet"
        error.add_note(whole)
        raise


def _begin_folder(runner: KirasRunner) -> None:
    assert runner.run_dir is not None
    for folder in (runner.run_dir, runner.run_dir / checkpoint.FOLDER):
        remove_leftovers(folder)
    save_config(runner.config, runner.run_dir / CONFIG)


def is_finished(run_dir: Path, iterations: int) -> bool:
    """Tell whether a run came to its end and all that it leaves behind is there.

    Args:
        run_dir: Its folder.
        iterations: Of all its phases.

    Raises:
        CheckpointError: Its latest checkpoint is unusable.
    """
    latest = run_dir / checkpoint.FOLDER / checkpoint.LATEST
    if not latest.is_file() or not (run_dir / POLICY).is_file():
        return False
    return checkpoint.load_checkpoint(latest)["iteration"] == iterations


def _next_phase(before: KirasRunner, phase: Phase) -> KirasRunner:
    """Return the learner of a phase, which begins where the one before ended.

    The best policy of skill learning stays in the run under a name of its own.
    """
    assert before.run_dir is not None
    folder = before.run_dir / checkpoint.FOLDER
    runner = build(phase, before.run_dir)
    runner.begin_from(folder / checkpoint.LATEST)
    distributed.from_main(lambda: _keep_flat(folder))
    runner.save_latest()  # from here on the run goes on in this phase
    return runner


def _keep_flat(folder: Path) -> None:
    best = folder / checkpoint.BEST
    if best.exists() and checkpoint.load_checkpoint(best)["phase"] == SKILL_LEARNING:
        best.replace(folder / checkpoint.FLAT)


def _announce(runner: KirasRunner) -> None:
    config = runner.config
    backend = resolve_backend(config.sim.backend, torch.device(runner.device))
    phases = [runner.phase] if runner.begun_from else plan(config)
    lengths = [phase.config.iterations for phase in phases]
    ranks = distributed.size()
    steps = ranks * config.num_envs * config.learner.ppo.num_steps * sum(lengths)
    worlds = f"{config.num_envs} worlds" if ranks == 1 else f"{ranks} x {config.num_envs} worlds"
    console.print(
        Text(config.robot, style="bold", end=""),
        f": {_what_begins(runner)}, {', '.join(runner.env.skills)} | "
        f"{worlds}, {backend} physics, {runner.device} | "
        f"{' + '.join(map(str, lengths))} iterations, {steps / 1e6:.1f} M steps | "
        f"{runner.run_dir}",
        sep="",
        soft_wrap=True,
    )


def _what_begins(runner: KirasRunner) -> str:
    done = runner.current_learning_iteration
    if done == 0:
        return "training"
    if runner.begun_from and done == runner.config.iterations:
        return (
            f"finetuning at iteration {done}, from {runner.begun_from} "
            f"({runner.steps / 1e6:.1f} M steps of skill learning)"
        )
    return f"resuming at iteration {done}"


def _conclude(runner: KirasRunner) -> None:
    """Draw the curves, export the best policy, and say what there is and what to type next."""
    run_dir = runner.run_dir
    assert run_dir is not None
    best = checkpoint.find_checkpoint(run_dir)
    curves = draw_curves(run_dir)
    onnx = export_policy(*checkpoint.load_policy(best), run_dir / POLICY).path
    evaluators, policy = runner.evaluators, onboard_policy(OnboardPolicy(onnx))
    if evaluators.flat:
        results = {name: asdict(result) for name, result in evaluators.flat(policy).items()}
        for table in flat.tables({run_dir.name: results}, "Best policy, flat ground"):
            console.print(as_rich(table))
    if evaluators.terrain:
        console.print(as_rich(terrain.result_table(evaluators.terrain(policy))))
    folder = shlex.quote(str(run_dir))
    console.print(
        f"{runner.seconds / 60:.1f} min of training\n"
        f"checkpoint  {best}\nONNX        {onnx}\ncurves      {curves}\n"
        f"next:       kiras-play {folder} --trace trace.png\n"
        f"            tensorboard --logdir {folder}",
        soft_wrap=True,
    )
