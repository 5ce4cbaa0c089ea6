"""Whole iterations of KiRAS, rollout and update, that all begin in the same states."""

from __future__ import annotations

import copy
import time
from dataclasses import replace

import torch

from kiras_rl.envs import make_env
from kiras_rl.phases import Phase
from kiras_rl.process import single_threaded
from kiras_rl.runner import KirasRunner
from kiras_rl.schema import LearnerConfig
from kiras_rl.tools.benchmarks.timing import wait_for
from kiras_rl.tools.benchmarks.workload import Workload

_UNGATED = {"gate_update": "off", "both": "bootstrap_input"}
"""AdaBoot modes -> the same without withheld updates: what is measured is a full iteration."""


def ungated(learner: LearnerConfig) -> LearnerConfig:
    """Return a copy in which AdaBoot withholds no update of the estimator."""
    learner = copy.deepcopy(learner)
    if learner.estimator is not None:
        learner.estimator.adaboot = _UNGATED.get(
            learner.estimator.adaboot, learner.estimator.adaboot
        )
    return learner


class Training:
    """The learner of a phase on its environment, whose robots stand.

    Attributes:
        config: Of the phase alone.
        env: The environment.
        runner: The learner; it goes on learning while the environment goes back.
        state: Of the environment, where every iteration begins.
    """

    def __init__(self, phase: Phase, device: str) -> None:
        """Build both.

        Raises:
            ConfigError: As `make_env`.
            RobotError: As `make_env`.
        """
        self.config = replace(phase.config, learner=ungated(phase.config.learner))
        phase, self._device = replace(phase, config=self.config), device
        self.env = make_env(self.config, device)
        with single_threaded(device):
            work = Workload(self.env, self.config.sim, self.config.learner.ppo.num_steps, 0)
        self.state = work.state
        self.runner = KirasRunner(self.env, phase, None, device)

    def iterate(self) -> float:
        """Run one iteration and return its seconds."""
        self.env.load_state_dict(copy.deepcopy(self.state))
        wait_for(self._device)
        begin = time.perf_counter()
        self.runner._iterate()
        wait_for(self._device)
        return time.perf_counter() - begin

    def record_targets(self) -> list[torch.Tensor]:
        """Run one iteration; return the position targets of its steps, T x (N, J), rad."""
        sim, targets = self.env.sim, []
        step = sim.step

        def record(ctrl: torch.Tensor) -> None:
            targets.append(ctrl.clone())
            step(ctrl)

        sim.step = record
        try:
            self.iterate()
        finally:
            del sim.step
        return targets
