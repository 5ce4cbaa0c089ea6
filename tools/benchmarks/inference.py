"""How long a control step of the exported policy takes on this machine."""

from __future__ import annotations

import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rich.table import Table

from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.envs import make_env
from kiras_rl.phases import plan
from kiras_rl.runner import KirasRunner
from kiras_rl.schema import Config
from kiras_rl.tools.benchmarks.request import Figures, Request, native
from kiras_rl.tools.benchmarks.tables import make_table
from kiras_rl.tools.shared.policy_files import export_checkpoint, find_checkpoint

STEPS = 2000  # a round


def measure(request: Request) -> Figures:
    """Time the policy of a configuration, untrained, as a robot runs it: one frame, one thread.

    Raises:
        ConfigError: As `make_env`.
        RobotError: As `make_env`.
        PolicyError: The policy observes what a robot cannot measure.
    """
    policy = _export(native(request.config))
    policy.reset(policy.metadata.default_joint_pos)
    _step_times(policy)  # warms the caches up
    times = np.concatenate([_step_times(policy) for _ in range(request.rounds)])
    middle, slow = np.quantile(times, (0.5, 0.99)).tolist()
    return {"median_seconds": middle, "p99_seconds": slow}


def table(figures: Figures) -> list[Table]:
    """Return the duration of a control step."""
    step = make_table("exported policy, one thread", "median, ms", "p99, ms")
    ms = (f"{1e3 * figures[key]:.3f}" for key in ("median_seconds", "p99_seconds"))
    step.add_row("control step", *ms)
    return [step]


def _export(config: Config) -> OnboardPolicy:
    """Take the way of every trained policy: runner, checkpoint, ONNX file."""
    with TemporaryDirectory() as folder:
        run = Path(folder)
        KirasRunner(make_env(config), plan(config)[0], run, "cpu").save_latest()
        report = export_checkpoint(find_checkpoint(run), run / "policy.onnx")
        return OnboardPolicy(report.path)


def _step_times(policy: OnboardPolicy) -> np.ndarray:
    joints = np.array(policy.metadata.default_joint_pos)
    still, level = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    times = np.zeros(STEPS)
    for index in range(STEPS):
        begin = time.perf_counter()
        policy.step(joints, 0.0 * joints, level, still, still, 0)
        times[index] = time.perf_counter() - begin
    return times
