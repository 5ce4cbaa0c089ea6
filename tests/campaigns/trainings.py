"""Small trainings in processes of their own, for campaigns that end them, and how they compare."""

from __future__ import annotations

import multiprocessing
from contextlib import redirect_stderr, redirect_stdout
from multiprocessing.process import BaseProcess
from pathlib import Path

import torch

from kiras_rl.checkpoint import load_checkpoint
from kiras_rl.tools.train import main

SMALL = (
    *("--cfg", "smoke", "device=cpu", "sim.threads=1", "checkpoint_minutes=0"),
    *("iterations=4", "finetuning.iterations=3", "learner.ppo.num_steps=8"),
)
"""Both phases with evaluations; a checkpoint after every iteration."""

# What is imported once, before the processes fork.
_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(["kiras_rl.tools.train"])

_CLOCKS = ("seconds", "minutes")  # how long it took, which is never the same
_STATE = ("iteration", "phase", "learner", "env", "generators", "policy", "best_networks")


def start(runs: Path, output: Path) -> BaseProcess:
    """Start a training in a folder of runs, or go on with the one that is there."""
    process = _CONTEXT.Process(target=_train, args=(runs, output))
    process.start()
    return process


def train(runs: Path, output: Path) -> int:
    """Train, or go on, to the end; return the exit status."""
    process = start(runs, output)
    process.join()
    return process.exitcode or 0


def latest(runs: Path) -> Path | None:
    """Return the latest checkpoint of the one run in a folder, if there is one."""
    return next(runs.glob("smoke/*/checkpoints/latest.pt"), None)


def _train(runs: Path, output: Path) -> None:
    torch.set_num_threads(1)
    saved = latest(runs)
    arguments = ["--resume", str(saved.parents[1])] if saved else [*SMALL, "--runs", str(runs)]
    with output.open("w") as file, redirect_stdout(file), redirect_stderr(file):
        status = main(arguments)
    raise SystemExit(status)


def differences(one: Path, other: Path) -> list[str]:
    """Return what differs between two checkpoints, to the bit; clocks may."""
    a, b = load_checkpoint(one), load_checkpoint(other)
    return [where for part in _STATE for where in _differences(a[part], b[part], part)]


def _differences(a: object, b: object, where: str) -> list[str]:
    if isinstance(a, dict) and isinstance(b, dict):
        if a.keys() != b.keys():
            return [where]
        return [x for k in a if k not in _CLOCKS for x in _differences(a[k], b[k], f"{where}/{k}")]
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        if len(a) != len(b):
            return [where]
        pairs = enumerate(zip(a, b, strict=True))
        return [x for i, pair in pairs for x in _differences(*pair, f"{where}/{i}")]
    if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor):
        return [] if a.dtype == b.dtype and torch.equal(a.nan_to_num(), b.nan_to_num()) else [where]
    return [] if a == b else [where]
