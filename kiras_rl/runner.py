"""The runner: rollouts and updates, evaluation, logging, checkpoints that resume exactly."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import torch
from rsl_rl.runners import OnPolicyRunner
from rsl_rl.utils import check_nan
from tensordict import TensorDict
from torch.utils.tensorboard import SummaryWriter

from kiras_rl import __version__, checkpoint
from kiras_rl.algorithms.kiras import KirasPPO
from kiras_rl.config import config_to_dict
from kiras_rl.deploy.metadata import FORMAT as METADATA_FORMAT
from kiras_rl.evaluation.flat import Policy, SkillResult, as_scalars, score
from kiras_rl.evaluation.terrain import TerrainResult
from kiras_rl.interfaces import SkillEnv
from kiras_rl.phases import FINETUNING, SKILL_LEARNING, phase_config, total_iterations
from kiras_rl.process import (
    StopRequest,
    generator_states,
    set_generator_states,
    single_threaded,
)
from kiras_rl.schema import Config


class TrainingError(ValueError):
    """A training that cannot go on: says where it broke and what is left."""


@dataclass
class Status:
    """What a progress line shows after an iteration.

    Attributes:
        phase: Name of the phase, see kiras_rl.phases.
        iteration: Iterations done, over all phases.
        iterations: Iterations in all.
        steps: Environment steps done, over all phases.
        seconds: Wall time of this iteration.
        scalars: Everything that was logged for it.
        evaluation: The latest deterministic evaluation on flat ground, empty before the first.
        terrain: The latest one on terrain, None where there is none.
    """

    phase: str
    iteration: int
    iterations: int
    steps: int
    seconds: float
    scalars: dict[str, float]
    evaluation: dict[str, SkillResult]
    terrain: TerrainResult | None


@dataclass(frozen=True)
class Evaluators:
    """Judges of a policy without action noise; None where one is not wanted.

    Attributes:
        flat: Every skill on flat ground.
        terrain: Every skill on every terrain.
    """

    flat: Callable[[Policy], dict[str, SkillResult]] | None = None
    terrain: Callable[[Policy], TerrainResult] | None = None


class KirasRunner(OnPolicyRunner):
    """rsl-rl's runner for one phase, with self-contained checkpoints and one log per rollout.

    `current_learning_iteration` counts over all phases.
    """

    alg: KirasPPO
    env: SkillEnv

    def __init__(
        self,
        env: SkillEnv,
        config: Config,
        run_dir: Path | None,
        device: str,
        evaluators: Evaluators | None = None,
        commit: str = "unknown",
        phase: str = SKILL_LEARNING,
    ) -> None:
        """Build the learner of a phase.

        Args:
            env: The training environment.
            config: The run, all its phases.
            run_dir: Folder of the run; None writes nothing.
            device: Of the networks.
            evaluators: Judge a policy without action noise, every evaluation.interval.
            commit: Of the source, for the provenance of the policy.
            phase: Which phase to train.
        """
        torch.manual_seed(config.seed)
        self.config, self.run_dir, self.phase = config, run_dir, phase
        settings = _rsl_rl_config(config, phase, env.step_dt)
        super().__init__(env, settings, log_dir=None, device=device)
        self._first = 0 if phase == SKILL_LEARNING else config.iterations
        self._last = self._first + settings["iterations"]
        self.current_learning_iteration = self._first
        self.evaluators, self.commit = evaluators or Evaluators(), commit
        self.evaluation: dict[str, SkillResult] = {}
        self.terrain: TerrainResult | None = None
        self.best_score = float("inf")
        self.best_networks: dict | None = None
        self.seconds, self.steps = 0.0, 0  # of training, over all phases and resumes
        self.begun_from: str | None = None  # another run's checkpoint that finetuning began with
        self._writer: SummaryWriter | None = None
        self._last_saved = time.monotonic()

    # --- the loop -------------------------------------------------------------------------------

    def learn(
        self,
        num_learning_iterations: int | None = None,
        init_at_random_ep_len: bool = False,
        on_iteration: Callable[[Status], None] | None = None,
        stop: StopRequest | None = None,
    ) -> bool:
        """Train until the phase is done or the process is asked to stop.

        SIGINT and SIGTERM let the iteration end, save, and return.

        Args:
            num_learning_iterations: At most this many now; None for all that remain.
            init_at_random_ep_len: Must be False: the environment spreads its episodes itself.
            on_iteration: Called after each iteration.
            stop: An open request, of a caller who has to know of it; None for one of this call.

        Returns:
            Whether all iterations of the phase are done.
        """
        if init_at_random_ep_len:
            raise ValueError("set env.terminations.random_first_length instead")
        last = self._last
        if num_learning_iterations is not None:
            last = min(last, self.current_learning_iteration + num_learning_iterations)
        self._open_log()
        with nullcontext(stop) if stop else StopRequest() as request:
            while self.current_learning_iteration < last and not request.requested:
                status = self._iterate()
                if on_iteration:
                    on_iteration(status)
                if time.monotonic() - self._last_saved > 60.0 * self.config.checkpoint_minutes:
                    self.save_latest()
            finished = self.current_learning_iteration >= self._last
            if finished and self.best_networks is None:  # nothing was evaluated
                self.best_networks = self.alg.networks()
            self.save_latest()
        self._close_log()
        return finished

    def _iterate(self) -> Status:
        begin = time.perf_counter()
        log = self._rollout()
        collected = time.perf_counter()
        scalars = self.alg.update()
        self._renew_skill_probabilities(scalars)
        learned = time.perf_counter()
        self.current_learning_iteration += 1
        steps = self.env.num_envs * self.cfg["num_steps_per_env"]
        self.steps += steps
        physics = log.pop("Perf/physics_time")
        scalars |= {key: value.item() for key, value in log.items()} | {
            "Perf/physics_time": physics.item(),
            "Perf/environment_time": self._env_time - physics.item(),
            "Perf/inference_time": collected - begin - self._env_time,
            "Perf/learning_time": learned - collected,
            "Perf/steps_per_second": steps / (learned - begin),
        }
        scalars |= self._evaluate_when_due()
        seconds = time.perf_counter() - begin
        self.seconds += seconds
        self._write(scalars)
        return Status(
            phase=self.phase,
            iteration=self.current_learning_iteration,
            iterations=total_iterations(self.config),
            steps=self.steps,
            seconds=seconds,
            scalars=scalars,
            evaluation=self.evaluation,
            terrain=self.terrain,
        )

    def _rollout(self) -> dict[str, torch.Tensor]:
        """Collect one rollout; return the environment's log, averaged over its steps."""
        totals: dict[str, torch.Tensor] = {}
        num_steps = self.cfg["num_steps_per_env"]
        self._env_time = 0.0
        obs = self.env.get_observations()
        # no_grad, not inference_mode: what is recorded here is trained on, and edited, later
        with torch.no_grad(), single_threaded(self.device):
            for _ in range(num_steps):
                actions = self.alg.act(obs)
                begin = time.perf_counter()
                obs, rewards, dones, extras = self.env.step(actions)
                self._env_time += time.perf_counter() - begin
                self.alg.process_env_step(obs, rewards, dones, extras)
                for key, value in extras["log"].items():
                    totals[key] = totals[key] + value if key in totals else value
        # Once a rollout: every check waits for the device. NaN in an earlier step is still
        # there, in the history of observations or in the stored rewards.
        self._check_finite(obs)
        with torch.no_grad():
            self.alg.compute_returns(obs)
        counts = ("Episode/", "Sim/", "Perf/")
        return {k: v if k.startswith(counts) else v / num_steps for k, v in totals.items()}

    def _check_finite(self, obs: TensorDict) -> None:
        try:
            check_nan(obs, self.alg.storage.task_rewards, self.alg.storage.dones)
        except ValueError as error:
            raise TrainingError(
                f"iteration {self.current_learning_iteration + 1}: {error} Worlds that diverge are "
                "reset before this, so look at your own terms or lower learner.ppo.learning_rate; "
                f"the last checkpoint stays as it is ({self.run_dir})"
            ) from None

    def _renew_skill_probabilities(self, scalars: dict[str, float]) -> None:
        probabilities = self.alg.skill_probabilities(self.env.keyframe_observations())
        if probabilities is None:
            return
        self.env.set_skill_probabilities(probabilities)
        for name, value in zip(self.env.skills, probabilities.tolist(), strict=True):
            scalars[f"Skill/probability_{name}"] = value

    def _evaluate_when_due(self) -> dict[str, float]:
        interval, done = self.config.evaluation.interval, self.current_learning_iteration
        if not self.evaluators.flat or not interval or (done % interval and done != self._last):
            return {}
        begin = time.perf_counter()
        with single_threaded(self.device):
            self.evaluation = self.evaluators.flat(self.alg.act_deterministic)
            if self.evaluators.terrain:
                self.terrain = self.evaluators.terrain(self.alg.act_deterministic)
        scalars = as_scalars(self.evaluation)
        if self.terrain:
            scalars |= self.terrain.as_scalars()
        self._keep_best()
        return scalars | {"Perf/evaluation_time": time.perf_counter() - begin}

    def _keep_best(self) -> None:
        current = score(self.evaluation)
        if self.terrain:
            current += self.terrain.score()
        if current < self.best_score:
            self.best_score = current
            self.best_networks = self.alg.networks()
            self._save_as(checkpoint.BEST)

    # --- log ------------------------------------------------------------------------------------

    def _open_log(self) -> None:
        if self.run_dir is not None:
            # purge_step: after a resume, points that a lost stretch had written disappear
            self._writer = SummaryWriter(
                str(self.run_dir), purge_step=self.current_learning_iteration + 1, flush_secs=10
            )

    def _write(self, scalars: dict[str, float]) -> None:
        if self._writer is not None:
            for key, value in scalars.items():
                self._writer.add_scalar(key, value, self.current_learning_iteration)

    def _close_log(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    # --- checkpoints ----------------------------------------------------------------------------

    def save_latest(self) -> None:
        """Write the latest checkpoint of the run."""
        self._save_as(checkpoint.LATEST)
        self._last_saved = time.monotonic()

    def _save_as(self, name: str) -> None:
        if self.run_dir is not None:
            self.save(str(self.run_dir / checkpoint.FOLDER / name))

    def save(self, path: str, infos: dict | None = None) -> None:
        """Write everything that training depends on to `path`."""
        policy = self.alg.policy()
        content = {
            "config": config_to_dict(self.config),
            "phase": self.phase,
            "skills": list(self.env.skills),
            "iteration": self.current_learning_iteration,
            "seconds": self.seconds,
            "best_score": self.best_score,
            "best_networks": self.best_networks,
            "learner": self.alg.save(),
            "env": self.env.state_dict(),
            "generators": generator_states(),
            "policy": policy.state_dict(),
            "policy_shape": policy.shape(),
            "description": self.describe_policy(),
            "infos": infos,
        }
        checkpoint.save_checkpoint(Path(path), content)

    def describe_policy(self) -> dict:
        """Return the policy's metadata with where it comes from."""
        provenance = {
            "iterations": self.current_learning_iteration,
            "steps": self.steps,
            "minutes": round(self.seconds / 60, 1),
            "begun_from": self.begun_from,
            "commit": self.commit,
            "versions": checkpoint.versions(),
            "config": config_to_dict(self.config),
        }
        header = {"format": METADATA_FORMAT, "version": __version__, "provenance": provenance}
        return header | self.env.describe()

    def load(
        self,
        path: str,
        load_cfg: dict | None = None,
        strict: bool = True,
        map_location: str | None = None,
    ) -> dict | None:
        """Go on exactly from a checkpoint.

        Raises:
            CheckpointError: Unusable file, or one of other skills.
        """
        content = self._read(path)
        if content["phase"] != self.phase:
            raise checkpoint.CheckpointError(
                f"{path} is of the phase {content['phase']}, not of {self.phase}"
            )
        self.alg.load(content["learner"], load_cfg, strict)
        self.env.load_state_dict(content["env"])
        self.current_learning_iteration = content["iteration"]
        self.seconds, self.best_score = content["seconds"], content["best_score"]
        self.best_networks = content["best_networks"]
        provenance = content["description"]["provenance"]
        self.steps, self.begun_from = provenance["steps"], provenance.get("begun_from")
        set_generator_states(content["generators"])
        return content["infos"]

    def begin_from(self, path: Path) -> None:
        """Begin this phase with the best networks in a checkpoint of the one before.

        Best by deterministic evaluation; those at the end where none was evaluated.

        Raises:
            CheckpointError: Unusable file, or one of other skills.
        """
        content = self._read(path)
        self.alg.begin_from(content["best_networks"], content["learner"])
        self.seconds = content["seconds"]
        self.steps = content["description"]["provenance"]["steps"]
        if self.alg.sampler:
            self.env.set_skill_probabilities(self.alg.sampler.probabilities)

    def _read(self, path: str | Path) -> dict:
        content = checkpoint.load_checkpoint(Path(path))
        if content["skills"] != list(self.env.skills):
            raise checkpoint.CheckpointError(
                f"{path} was trained on the skills {', '.join(content['skills'])}; the robot has "
                f"{', '.join(self.env.skills)}: mend its keyframes.yaml or start a new run"
            )
        return content


def _rsl_rl_config(config: Config, phase: str, step_dt: float) -> dict:
    alone = phase_config(config, phase)
    finetuning = config.finetuning if phase == FINETUNING else None
    return {
        "algorithm": {"class_name": "kiras_rl.algorithms.kiras.KirasPPO"},
        "learner": alone.learner,
        "iterations": alone.iterations,
        "retention": finetuning.retention if finetuning else None,
        "reward_scale": step_dt if config.env.rewards.scale_by_dt else 1.0,
        "num_steps_per_env": alone.learner.ppo.num_steps,
        "save_interval": 0,
    }
