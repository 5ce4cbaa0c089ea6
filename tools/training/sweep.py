"""Sweeps: several configurations and seeds, trained one after the other or side by side.

What was done is read from the folders of the runs and kept nowhere else.
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.table import Table
from rich.text import Text
from torch import OutOfMemoryError

from kiras_rl.checkpoint import LATEST, CheckpointError, find_checkpoint, load_checkpoint
from kiras_rl.config import (
    MACHINE_KEYS,
    SWEEP_FOLDER,
    ConfigError,
    config_from_dict,
    config_to_dict,
    load_config,
    read_keys,
)
from kiras_rl.deploy.errors import PlainError
from kiras_rl.ownership import owning
from kiras_rl.phases import plan, total_iterations
from kiras_rl.process import StopRequest
from kiras_rl.runner import KirasRunner
from kiras_rl.schema import Config
from kiras_rl.tools.training.run import (
    CONFIG,
    begin,
    build,
    check,
    console,
    is_finished,
    message_of,
    resume,
    train_run,
)


@dataclass
class Variant:
    """One configuration of a sweep, with overrides of its own."""

    cfg: str
    overrides: list[str] = field(default_factory=list)


@dataclass
class SweepFile:
    """What a sweep's YAML file holds; `configs` is by label, which may be left out there."""

    name: str
    configs: dict[str, Variant]
    seeds: list[int]
    overrides: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Run:
    """One run of a sweep: configuration with its seed, and the folder it lives in."""

    label: str
    config: Config
    folder: Path

    @property
    def name(self) -> str:
        """Label and seed."""
        return f"{self.label}/{self.folder.name}"

    def is_finished(self) -> bool:
        """Tell whether nothing is left to do; raises CheckpointError if that is unreadable."""
        return is_finished(self.folder, total_iterations(self.config))

    def checkpoint(self) -> Path | None:
        """Return the checkpoint to go on from, None before there is one."""
        with suppress(CheckpointError):
            return find_checkpoint(self.folder, prefer=LATEST)
        return None


# --- the file ------------------------------------------------------------------------------------


def list_sweeps() -> list[str]:
    """Return the names of the shipped sweeps."""
    return sorted(path.stem for path in SWEEP_FOLDER.glob("*.yaml"))


def load_sweep(name: str, overrides: list[str], runs: Path, only: str | None = None) -> list[Run]:
    """Read a sweep and load all its configurations.

    Args:
        name: A file of cfg/sweeps/ without its ending, or a path.
        overrides: `key=value` strings for all runs, applied last.
        runs: Where runs are written.
        only: Name of the one run that is wanted, label/seed_N; None for all of them.

    Returns:
        The runs in their order: all configurations of a seed, then those of the next.

    Raises:
        ConfigError: A file or configuration that cannot be used, or that is no longer the one with
            which a run of this sweep was begun, or a sweep without the run that is wanted.
    """
    path = _find(name)
    sweep = _read(path)
    configs = {}
    for label, variant in sweep.configs.items():
        changes = [*sweep.overrides, *variant.overrides, *overrides]
        configs[label] = _load(path, label, variant.cfg, changes)
    folder = runs / "sweeps" / sweep.name
    result = [
        Run(label, replace(config, seed=seed), folder / label / f"seed_{seed}")
        for seed in sweep.seeds
        for label, config in configs.items()
    ]
    if only is not None:
        result = [_named(only, result)]
    for run in result:
        _check_unchanged(run)
    return result


def _named(name: str, runs: list[Run]) -> Run:
    for run in runs:
        if run.name == name:
            return run
    raise ConfigError(f"--only {name}: this sweep has {', '.join(run.name for run in runs)}")


def _find(name: str) -> Path:
    for path in (SWEEP_FOLDER / f"{name}.yaml", Path(name)):
        if path.is_file():
            return path
    raise ConfigError(
        f"no sweep '{name}': shipped are {', '.join(list_sweeps())}, or give the path of a YAML "
        "file"
    )


def _read(path: Path) -> SweepFile:
    values = read_keys(path)
    values["configs"] = _by_label(values.get("configs"), path)
    try:
        merged = OmegaConf.merge(OmegaConf.structured(SweepFile), values)
        missing = sorted(OmegaConf.missing_keys(merged))
        sweep = None if missing else OmegaConf.to_object(merged)
    except OmegaConfBaseException as error:
        key, reason = getattr(error, "full_key", None), str(error).splitlines()[0]
        raise ConfigError(
            f"{path}: {key}: {reason}; a sweep has name, configs (each cfg, overrides), seeds, "
            "overrides"
        ) from None
    if missing:
        raise ConfigError(f"{path} leaves out: {', '.join(missing)}")
    assert isinstance(sweep, SweepFile)
    _check_names(sweep, path)
    return sweep


def _by_label(configs: Any, path: Path) -> dict:
    """Return label -> values of a Variant; without a label, the last part of a name is it."""
    if isinstance(configs, list) and all(isinstance(name, str) for name in configs):
        labels = [Path(name.removesuffix(".yaml")).name for name in configs]
        twice = [label for label, count in Counter(labels).items() if count > 1]
        if twice:
            raise ConfigError(
                f"{path}: two configurations would be called {twice[0]}: name each, as in "
                "configs: {label: configuration}"
            )
        configs = dict(zip(labels, configs, strict=True))
    if not isinstance(configs, dict) or not configs:
        raise ConfigError(
            f"{path}: configs: give names, [solo8, ablations/no_sil], or a mapping, label: name or "
            "label: {cfg: name, overrides: [key=value]}"
        )
    return {k: {"cfg": v} if isinstance(v, str) else v for k, v in configs.items()}


def _check_names(sweep: SweepFile, path: Path) -> None:
    for name in (sweep.name, *sweep.configs):
        if not re.fullmatch(r"\w[\w.-]*", name):
            raise ConfigError(f"{path}: '{name}' names a folder: use letters, digits, . _ and -")
    if not sweep.seeds or len(set(sweep.seeds)) < len(sweep.seeds):
        raise ConfigError(f"{path}: seeds: {sweep.seeds}: give at least one, and none twice")


def _load(path: Path, label: str, cfg: str, overrides: list[str]) -> Config:
    for item in overrides:
        if not isinstance(item, str):  # YAML reads `key={weight: 1}` as a mapping
            raise ConfigError(f"{path}: {label}: overrides: put quotes around {item}")
        if item.partition("=")[0] == "seed":
            raise ConfigError(f"{path}: a sweep has a list of seeds: set `seeds` there, not seed=")
    try:
        return load_config(cfg, overrides)
    except ConfigError as error:
        raise ConfigError(f"{path}: {label}: {error}") from None


def _check_unchanged(run: Run) -> None:
    """Refuse a run that was begun with other values than the sweep has now."""
    path = run.folder / CONFIG
    if not path.is_file() or run.checkpoint() is None:
        return
    saved = config_from_dict(read_keys(path))
    for key, old, new in _changes(config_to_dict(saved), config_to_dict(run.config)):
        if key not in MACHINE_KEYS:
            raise ConfigError(
                f"{run.folder} was begun with {key}={_brief(old)}, the sweep has {_brief(new)}: "
                "undo the change, give the sweep another name, or remove the run"
            )


def _changes(old: dict, new: dict, prefix: str = "") -> Iterator[tuple[str, Any, Any]]:
    """List where two nested configurations differ: dotted key and both values."""
    for key in old | new:
        a, b = old.get(key), new.get(key)
        if isinstance(a, dict) and isinstance(b, dict):
            yield from _changes(a, b, f"{prefix}{key}.")
        elif a != b:
            yield prefix + key, a, b


def _brief(value: Any) -> str:
    if isinstance(value, dict):
        return "{...}"
    return "null" if value is None else str(value)


# --- the training --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Report:
    """How far a sweep is.

    Attributes:
        runs: All its runs.
        failures: Names of those that broke.
        stopped: Whether it was asked to stop while there was more to do.
    """

    runs: list[Run]
    failures: set[str]
    stopped: bool

    def table(self) -> Table:
        """Return a table with one row a run."""
        table = Table(title="sweep", title_justify="left")
        for column in ("configuration", "seed", "iterations", "M steps", "minutes", "status"):
            right = column in ("iterations", "M steps", "minutes")
            table.add_column(column, justify="right" if right else "left")
        for run in self.runs:
            row = (run.label, str(run.config.seed), *_amounts(run), self._status(run))
            table.add_row(*row)
        return table

    def _status(self, run: Run) -> str:
        if run.name in self.failures:
            return "failed"
        if run.checkpoint() is None:
            return "not begun"
        try:
            return "finished" if run.is_finished() else "interrupted"
        except CheckpointError:
            return "unreadable"


def _amounts(run: Run) -> tuple[str, str, str]:
    """Return iterations, million steps and minutes that were trained."""
    try:
        content = load_checkpoint(find_checkpoint(run.folder, prefer=LATEST))
    except CheckpointError:
        return "-", "-", "-"
    steps = content["description"]["provenance"]["steps"]
    return str(content["iteration"]), f"{steps / 1e6:.2f}", f"{content['seconds'] / 60:.1f}"


def train_sweep(runs: list[Run]) -> Report:
    """Train the runs that are not finished; one that breaks is reported, and left behind.

    SIGINT and SIGTERM let the iteration end, save, and return.

    Raises:
        ConfigError: What a run could not use, before the first one trains.
    """
    try_out(runs)
    failures, done = set(), 0
    with StopRequest() as stop:
        for number, run in enumerate(runs, 1):
            if stop.requested:
                break
            if len(runs) > 1:
                console.print(Text(f"run {number}/{len(runs)}", style="bold"), run.name)
            try:
                done += _train(run, stop)
            except (PlainError, OSError, OutOfMemoryError) as error:
                print(f"error: {run.name}: {message_of(error)}", file=sys.stderr)
                failures.add(run.name)
    return Report(runs, failures, stop.requested and done + len(failures) < len(runs))


def try_out(runs: list[Run]) -> None:
    """Build each configuration once, with one world: what it refuses is refused now."""
    for label, config in {run.label: run.config for run in runs}.items():
        try:
            check(config)
            build(plan(config)[0], None, num_envs=1)
        except (PlainError, OSError, OutOfMemoryError) as error:
            raise ConfigError(f"{label}: {error}") from None


def _train(run: Run, stop: StopRequest) -> bool:
    """Train a run from where it was left; return whether it is finished."""
    if run.is_finished():
        console.print(f"finished before: {run.folder}", highlight=False, soft_wrap=True)
        return True
    with owning(run.folder):
        return train_run(_open(run), stop)


def _open(run: Run) -> KirasRunner:
    """Return the learner of a run as it was left, or a new one."""
    source = run.checkpoint()
    if source is not None:
        values = OmegaConf.create(config_to_dict(run.config))
        return resume(source, [f"{key}={OmegaConf.select(values, key)}" for key in MACHINE_KEYS])
    runner = begin(run.config)
    runner.run_dir = run.folder
    return runner
