"""What is measured: a policy, its physics, and the results so far."""

from __future__ import annotations

import copy
import hashlib
import itertools
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from kiras_rl.config import ConfigError
from kiras_rl.deploy.policy import OnboardPolicy, PolicyMetadata
from kiras_rl.envs import resolve_backend
from kiras_rl.envs.quadruped import QuadrupedEnv
from kiras_rl.evaluation.flat import Policy
from kiras_rl.phases import plan
from kiras_rl.robots.robot import Robot
from kiras_rl.schema import Config, TerrainConfig
from kiras_rl.tools.evaluation.evaluator import (
    evaluation_physics,
    make_evaluation_env,
    onboard_policy,
    standard_config,
    trained_config,
)
from kiras_rl.tools.evaluation.report.ledger import Ledger
from kiras_rl.tools.shared.policy_files import find_policy, load_policy, robot_of, shipped_policy


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
        ledger: Its results so far.
        options: What the user changed.
        progress: Of the protocol at hand.
    """

    label: str
    source: Path
    onboard: OnboardPolicy
    ledger: Ledger
    options: Options = field(default_factory=Options)
    progress: Progress = field(default_factory=Progress)

    @classmethod
    def load(
        cls, source: Path | None, robot: str | None, folder: Path | None, options: Options
    ) -> Subject:
        """Load what a user points at; see `policy_files.load_policy`.

        Without `folder` the results of a run lie in its folder evaluation/, others in
        evaluation/<label>/, or beside that where it holds those of another policy.

        Raises:
            ConfigError: If `folder` holds the results of another policy.
            PolicyError: If there is no policy, or one of another robot.
        """
        onboard = load_policy(source, robot)
        file = shipped_policy(robot or onboard.metadata.robot) if source is None else source
        file = find_policy(file)
        label = _label(file if source is None else source)
        about = _describe(label, file, onboard.metadata)
        if folder is None:
            in_run = source / "evaluation" if source is not None and source.is_dir() else None
            ledger = Ledger.beside(in_run or Path("evaluation") / label, about)
        else:
            ledger = Ledger(folder, about)
        return cls(label, file, onboard, ledger, options)

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

    def results(self, pieces: Mapping[str, Callable[[], dict | list]]) -> dict[str, Any]:
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

    @property
    def folder(self) -> Path:
        """Where the results are kept."""
        return self.ledger.path.parent

    @cached_property
    def run(self) -> Config:
        """The configuration of the training."""
        return trained_config(self.onboard.metadata)

    @cached_property
    def robot(self) -> Robot:
        """The robot as it was in training."""
        return robot_of(self.onboard.metadata)

    @property
    def is_finetuned(self) -> bool:
        """Whether it has been trained on terrain."""
        return self.onboard.metadata.provenance.get("iterations", 0) > self.run.iterations

    def flat(self) -> Config:
        """Return the configuration of flat ground."""
        return self._physics(plan(self.run)[0].config)

    def rough(self) -> Config:
        """Return the configuration of the robot's standard terrain."""
        standard = plan(standard_config(self.run.robot))[-1].config
        config = self.flat()
        config.env.terrain = standard.env.terrain
        for capacity in ("max_contacts", "max_constraints", "max_ccd"):
            setattr(config.sim, capacity, getattr(standard.sim, capacity))
        return config

    @property
    def terrain(self) -> TerrainConfig:
        """The robot's standard terrain, to be changed.

        Raises:
            ConfigError: The robot's standard has none.
        """
        terrain = self.rough().env.terrain
        if terrain is None:
            raise ConfigError(f"the standard configuration of {self.run.robot} has no terrain")
        return terrain

    def make_env(self, config: Config, num_envs: int, duration: float) -> QuadrupedEnv:
        """Build an environment for trials of the policy's own robot; see `make_evaluation_env`."""
        return make_evaluation_env(config, num_envs, duration, self.options.device, self.robot)

    def _physics(self, config: Config) -> Config:
        config = evaluation_physics(copy.deepcopy(config), self.options.nominal)
        config.sim.backend = self.options.backend
        return config

    def key(self, protocol: str, **parts: object) -> str:
        """Return the name of a result: all that it depends on beside the policy."""
        device = torch.device(self.options.device)
        common = {
            "nominal": self.options.nominal,
            "backend": resolve_backend(self.options.backend, device),
            "device": device.type,
            "physics": self._physics_digest,
        }
        return " ".join([protocol, *(f"{name}={part}" for name, part in (parts | common).items())])

    @cached_property
    def _physics_digest(self) -> str:
        """A short name of robot, simulation and environment: other ones give other results."""
        contract = self.onboard.metadata.to_dict() | {"provenance": None, "version": None}
        mjcf = self.robot.mjcf.read_text(encoding="utf-8")
        motor = [values.tolist() for values in vars(self.robot.motor).values()]
        machine = {"backend": None, "threads": None}  # the first one is in the key by itself
        grounds = [(asdict(c.sim) | machine, asdict(c.env)) for c in (self.flat(), self.rough())]
        text = json.dumps([contract, mjcf, motor, *grounds], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:8]


def _describe(label: str, source: Path, metadata: PolicyMetadata) -> dict:
    """Return what tells a policy from others, for the files."""
    return {
        "label": label,
        "source": str(source),
        "sha256": hashlib.sha256(source.read_bytes()).hexdigest(),
        "robot": metadata.robot,
        "skills": list(metadata.skills),
        "provenance": metadata.provenance,
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
