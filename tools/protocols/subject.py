"""What is measured: a policy, its physics, and the results so far."""

from __future__ import annotations

import copy
import hashlib
import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from kiras_rl.config import list_configs, load_config
from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.envs.quadruped import QuadrupedEnv
from kiras_rl.evaluation.flat import Policy
from kiras_rl.phases import FINETUNING, SKILL_LEARNING, phase_config
from kiras_rl.schema import Config
from kiras_rl.tools.evaluator import evaluation_physics, onboard_policy, trained_config
from kiras_rl.tools.policy_files import find_policy, load_policy, shipped_policy
from kiras_rl.tools.report.ledger import Ledger


@dataclass(frozen=True)
class Options:
    """What a user may change of the protocols.

    Attributes:
        robots: For each skill (flat, imitation, robustness).
        duration: Of a trial on flat ground, s.
        trials: Of a cell; None for the protocol's own number.
        levels: Of difficulty, 0 to 10 (terrain).
        command: v_x on flat ground, m/s.
        nominal: No randomization, noise, delay or pushes.
        backend: See sim.backend.
        device: Of the simulation: cpu or cuda.
    """

    robots: int = 100
    duration: float = 20.0
    trials: int | None = None
    levels: tuple[int, ...] = (0, 2, 4, 6, 8, 10)
    command: float = 0.3
    nominal: bool = False
    backend: str = "auto"
    device: str = "cpu"

    def trials_or(self, default: int) -> int:
        """Return the trials of a cell, `default` where the user asked for none."""
        return default if self.trials is None else self.trials


@dataclass
class Progress:
    """How much of a protocol is measured.

    Attributes:
        show: Called with that share, 0 to 1, whenever it grows.
        pieces: What there is to measure.
        done: How many of the pieces are.
    """

    show: Callable[[float], object] = lambda share: None
    pieces: int = 1
    done: int = 0

    def tell(self, share: float) -> None:
        """Show that a share of the piece at hand is measured, 0 to 1."""
        self.show((self.done + min(share, 1.0)) / self.pieces)


@dataclass(frozen=True)
class Subject:
    """A policy to measure.

    Attributes:
        label: How tables and figures call it.
        source: The file that it came from.
        onboard: The policy as the robot runs it.
        folder: Where its results are kept.
        options: What the user changed.
        progress: Of the protocol at hand.
    """

    label: str
    source: Path
    onboard: OnboardPolicy
    folder: Path
    options: Options = field(default_factory=Options)
    progress: Progress = field(default_factory=Progress)

    @classmethod
    def load(
        cls, source: Path | None, robot: str | None, folder: Path | None, options: Options
    ) -> Subject:
        """Load what a user points at; see `policy_files.load_policy`.

        Without `folder` the results of a run lie in its folder evaluation/, others in
        evaluation/<label>/.

        Raises:
            PolicyError: If there is no policy, or one of another robot.
        """
        onboard = load_policy(source, robot)
        file = shipped_policy(robot or onboard.metadata.robot) if source is None else source
        file = find_policy(file)
        label = _label(file if source is None else source)
        if folder is None:
            is_run = source is not None and source.is_dir()
            folder = source / "evaluation" if is_run else Path("evaluation") / label
        return cls(label, file, onboard, folder, options)

    @property
    def skills(self) -> tuple[str, ...]:
        """Names of the skills."""
        return tuple(self.onboard.metadata.skills)

    def policy_in(self, env: QuadrupedEnv) -> Policy:
        """Return observation -> mean actions; every step in the environment is progress."""
        policy, steps = onboard_policy(self.onboard), itertools.count(1)

        def act(obs: TensorDict) -> torch.Tensor:
            self.progress.tell(next(steps) / env.max_episode_length)
            return policy(obs)

        return act

    def results(self, pieces: dict[str, Callable[[], dict | list]]) -> dict[str, Any]:
        """Return the results by key; what the ledger lacks is measured, and kept piece by piece.

        Args:
            pieces: Key -> what measures it; see `Ledger.get`.
        """
        self.progress.pieces = max(1, sum(key not in self.ledger for key in pieces))
        self.progress.done = 0
        results = {}
        for key, measure in pieces.items():
            missing = key not in self.ledger
            results[key] = self.ledger.get(key, measure)
            self.progress.done += missing
        return results

    @cached_property
    def ledger(self) -> Ledger:
        """The results so far."""
        return Ledger(self.folder, self.describe())

    @cached_property
    def run(self) -> Config:
        """The configuration of the training."""
        return trained_config(self.onboard.metadata)

    @property
    def is_finetuned(self) -> bool:
        """Whether it has been trained on terrain."""
        return self.onboard.metadata.provenance.get("iterations", 0) > self.run.iterations

    def flat(self) -> Config:
        """Return the configuration of flat ground."""
        return self._physics(phase_config(self.run, SKILL_LEARNING))

    def rough(self) -> Config:
        """Return the configuration of terrain, its robot's own for one that was trained without."""
        if self.run.finetuning:
            return self._physics(phase_config(self.run, FINETUNING))
        robot = self.run.robot
        standard = phase_config(
            load_config(robot if robot in list_configs() else "base"), FINETUNING
        )
        config = self.flat()
        config.sim, config.env.terrain = standard.sim, standard.env.terrain
        config.sim.backend = self.options.backend
        return config

    def _physics(self, config: Config) -> Config:
        config = evaluation_physics(copy.deepcopy(config), self.options.nominal)
        config.sim.backend = self.options.backend
        return config

    def key(self, protocol: str, **parts: object) -> str:
        """Return the name of a result: all that it depends on beside the policy."""
        common = {"nominal": self.options.nominal, "backend": self.options.backend}
        return " ".join([protocol, *(f"{name}={part}" for name, part in (parts | common).items())])

    def describe(self) -> dict:
        """Return what tells this policy from others, for the files."""
        return {
            "label": self.label,
            "source": str(self.source),
            "sha256": hashlib.sha256(self.source.read_bytes()).hexdigest(),
            "robot": self.onboard.metadata.robot,
            "skills": list(self.skills),
            "provenance": self.onboard.metadata.provenance,
        }


def _label(source: Path) -> str:
    """Return a short name: configuration/time of a run, the stem of a file."""
    source = source.resolve()
    if source.is_dir():
        return f"{source.parent.name}/{source.name}"
    in_run = source.parent.name == "checkpoints"
    if in_run:
        run = source.parent.parent
        return f"{run.parent.name}/{run.name}/{source.stem}"
    robot = f"{source.parent.parent.name}/" if source.parent.name == "policies" else ""
    return f"{robot}{source.stem}"
