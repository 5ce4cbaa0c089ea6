"""How long a control step of the exported policy takes on this machine."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.envs import make_env
from kiras_rl.runner import KirasRunner
from kiras_rl.schema import Config
from kiras_rl.tools.policy_files import export_checkpoint, find_checkpoint

STEPS = 2000  # a round


def measure_inference(config: Config, rounds: int) -> np.ndarray:
    """Time the policy of a configuration, untrained, as a robot runs it: one frame, one thread.

    Returns:
        Duration of each control step, (rounds * STEPS,), s.

    Raises:
        ConfigError: As `make_env`.
        RobotError: As `make_env`.
        PolicyError: The policy observes what a robot cannot measure.
    """
    policy = _export(replace(config, sim=replace(config.sim, backend="native")))
    policy.reset(policy.metadata.default_joint_pos)
    _step_times(policy)  # warms the caches up
    return np.concatenate([_step_times(policy) for _ in range(rounds)])


def _export(config: Config) -> OnboardPolicy:
    """Take the way of every trained policy: runner, checkpoint, ONNX file."""
    with TemporaryDirectory() as folder:
        run = Path(folder)
        KirasRunner(make_env(config), config, run, "cpu").save_latest()
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
