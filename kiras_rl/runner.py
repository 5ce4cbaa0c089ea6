"""The runner: rollouts and updates, evaluation, logging, checkpoints that resume exactly."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import torch
from rsl_rl.runners import OnPolicyRunner
from torch.utils.tensorboard import SummaryWriter

from kiras_rl import __version__, checkpoint, distributed
from kiras_rl import interfaces as names
from kiras_rl.algorithms.kiras import KirasPPO
from kiras_rl.classes import find_class
from kiras_rl.config import config_to_dict
from kiras_rl.deploy.metadata import FORMAT as METADATA_FORMAT
from kiras_rl.evaluation.flat import Policy, SkillResult, as_scalars, score
from kiras_rl.evaluation.terrain import TerrainResult
from kiras_rl.interfaces import SkillEnv
from kiras_rl.phases import Phase, total_iterations
from kiras_rl.process import StopRequest, generator_states, set_generator_states, single_threaded
from kiras_rl.soundness import TrainingError, check_rollout, check_update
from kiras_rl.status import Status

POOLED = 3
"""Evaluations whose mean score tells which policy is best: one alone is a matter of luck."""

COUNTS = ("Episode/", "Sim/")
"""Tags of numbers that are added up, over the steps of a rollout and over the ranks."""

ANEW = (
    "%s is of a run with %d rank(s), this one has %d: networks, optimizers, premium buffer and "
    "statistics go on, all worlds begin anew"
)

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Evaluators:
    """Judges of a policy without action noise; None where one is not wanted.

    Attributes:
        flat: Every skill on flat ground.
        terrain: Every skill on every terrain.
    """

    flat: Callable[[Policy], dict[str, SkillResult]] | None = None
    terrain: Callable[[Policy], TerrainResult] | None = None


def shares_of_ends(scalars: dict[str, float]) -> dict[str, float]:
    """Return, for each reason of falls, its count divided by that of all episodes that ended."""
    ends = scalars.get(names.FALLS, 0.0) + scalars.get(names.TIME_OUTS, 0.0)
    return {k: n / max(ends, 1.0) for k, n in scalars.items() if k.startswith(names.ENDED_BY)}


class KirasRunner(OnPolicyRunner):
    """rsl-rl's runner for one phase, with self-contained checkpoints and one log per rollout.

    `current_learning_iteration` counts over all phases.
    """

    alg: KirasPPO
    env: SkillEnv

    def __init__(
        self,
        env: SkillEnv,
        phase: Phase,
        run_dir: Path | None,
        device: str,
        evaluators: Evaluators | None = None,
        commit: str = "unknown",
    ) -> None:
        """Build the learner of a phase.

        Args:
            env: The training environment.
            phase: Which phase to train.
            run_dir: Folder of the run; None writes nothing.
            device: Of the networks.
            evaluators: Judge a policy without action noise, every evaluation.interval.
            commit: Of the source, for the provenance of the policy.
        """
        torch.manual_seed(phase.run.seed + distributed.rank())
        self.config, self.run_dir, self.phase = phase.run, run_dir, phase
        settings = phase.learner_settings(env.step_dt)
        name = phase.config.learner.class_name
        settings["algorithm"]["class_name"] = find_class("learner.class_name", name, KirasPPO)
        super().__init__(env, settings, log_dir=None, device=device)
        self.alg.broadcast_parameters()
        self.current_learning_iteration = phase.first
        self.evaluators, self.commit = evaluators or Evaluators(), commit
        self.evaluation: dict[str, SkillResult] = {}
        self.terrain: TerrainResult | None = None
        self.scores: list[float] = []  # of the last POOLED evaluations
        self.best_score = float("inf")  # a mean of such
        self.best_networks: dict | None = None
        self.seconds, self.steps = 0.0, 0  # of training, over all phases and resumes
        self.begun_from: str | None = None  # another run's checkpoint that finetuning began with
        self.takes_changed_robot = False
        self._writer: SummaryWriter | None = None
        self._resumed = False
        self._last_saved = time.monotonic()

    def _configure_multi_gpu(self) -> None:
        """Leave the ranks to kiras_rl.distributed: rsl-rl's own set-up knows NCCL alone."""
        self.gpu_local_rank, self.gpu_global_rank = distributed.local_rank(), distributed.rank()
        self.gpu_world_size = distributed.size()
        self.is_distributed = self.gpu_world_size > 1

    # --- the loop -------------------------------------------------------------------------------

    def learn(
        self,
        num_learning_iterations: int | None = None,
        init_at_random_ep_len: bool = False,
        on_iteration: Callable[[Status], None] | None = None,
        stop: StopRequest | None = None,
    ) -> bool:
        """Train until the phase is done or the process is asked to stop.

        SIGINT and SIGTERM, on any rank, let the iteration end, save, and return.

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
        last = self.phase.last
        if num_learning_iterations is not None:
            last = min(last, self.current_learning_iteration + num_learning_iterations)
        self._open_log()
        with nullcontext(stop) if stop else StopRequest() as request:
            while self.current_learning_iteration < last and not request.agree():
                status = self._iterate()
                if on_iteration:
                    on_iteration(status)
                age = time.monotonic() - self._last_saved
                if distributed.any_rank(age > 60.0 * self.config.checkpoint_minutes):
                    self.save_latest()
            finished = self.current_learning_iteration >= self.phase.last
            if finished and self.best_networks is None:  # nothing was evaluated
                self.best_networks = self.alg.networks()
            self.save_latest()
        self._close_log()
        return finished

    def _iterate(self) -> Status:
        try:
            return self._collect_and_learn()
        except TrainingError as error:
            raise TrainingError(
                f"iteration {self.current_learning_iteration + 1}: {error}; "
                f"the last checkpoint stays as it is ({self.run_dir})"
            ) from None

    def _collect_and_learn(self) -> Status:
        begin = time.perf_counter()
        log = self._rollout()
        collected = time.perf_counter()
        scalars = self.alg.update()
        self._renew_skill_probabilities(scalars)
        learned = time.perf_counter()
        check_update(scalars)
        self.current_learning_iteration += 1
        steps = self.env.num_envs * self.cfg["num_steps_per_env"] * distributed.size()
        self.steps += steps
        scalars |= log | {
            "Perf/physics_time": self._physics_time,
            "Perf/environment_time": self._env_time - self._physics_time,
            "Perf/inference_time": collected - begin - self._env_time,
            "Perf/learning_time": learned - collected,
            "Perf/steps_per_second": steps / (learned - begin),
        }
        scalars = distributed.mean_scalars(scalars, summed=COUNTS)
        scalars |= shares_of_ends(scalars)
        scalars |= self._evaluate_when_due()
        seconds = time.perf_counter() - begin
        self.seconds += seconds
        self._write(scalars)
        return Status(
            phase=self.phase.name,
            iteration=self.current_learning_iteration,
            iterations=total_iterations(self.config),
            steps=self.steps,
            seconds=seconds,
            scalars=scalars,
            evaluation=self.evaluation,
            terrain=self.terrain,
        )

    def _rollout(self) -> dict[str, float]:
        """Collect one rollout; return the environment's log, averaged over its steps."""
        log: dict[str, torch.Tensor] = {}
        totals = torch.zeros((), device=self.device)
        num_steps = self.cfg["num_steps_per_env"]
        self._env_time = self._physics_time = 0.0
        self.env.set_progress(self.alg.progress)
        obs = self.env.get_observations()
        # no_grad, not inference_mode: what is recorded here is trained on, and edited, later
        with torch.no_grad(), single_threaded(self.device):
            for _ in range(num_steps):
                actions = self.alg.act(obs)
                begin = time.perf_counter()
                obs, rewards, dones, extras = self.env.step(actions)
                self._env_time += time.perf_counter() - begin
                self.alg.process_env_step(obs, rewards, dones, extras)
                self._physics_time += extras[names.EXTRA_PHYSICS_TIME]
                log = extras["log"]  # the same names in every step
                totals = totals + torch.stack(tuple(log.values())) if log else totals
        self.alg.compute_returns(obs)
        values = zip(log, totals.tolist(), strict=True) if log else ()
        means = {k: v if k.startswith(COUNTS) else v / num_steps for k, v in values}
        check_rollout(obs, self.alg.storage, means, self.env.name_term)
        return means

    def _renew_skill_probabilities(self, scalars: dict[str, float]) -> None:
        self.alg.choose_skills(self.env.keyframe_observations())
        self._tell_skill_probabilities()
        if (probabilities := self.alg.skill_probabilities) is not None:
            for name, value in zip(self.env.skills, probabilities.tolist(), strict=True):
                scalars[f"Skill/probability_{name}"] = value

    def _evaluate_when_due(self) -> dict[str, float]:
        interval, done = self.config.evaluation.interval, self.current_learning_iteration
        is_due = interval and (done % interval == 0 or done == self.phase.last)
        if not self.evaluators.flat or not is_due:
            return {}
        begin = time.perf_counter()
        self.evaluation, self.terrain = distributed.from_main(self._evaluate)
        scalars = as_scalars(self.evaluation)
        if self.terrain:
            scalars |= self.terrain.as_scalars()
        self._keep_best()
        return scalars | {"Perf/evaluation_time": time.perf_counter() - begin}

    def _evaluate(self) -> tuple[dict[str, SkillResult], TerrainResult | None]:
        flat, terrain = self.evaluators.flat, self.evaluators.terrain
        policy = self.alg.act_deterministic
        with single_threaded(self.device):
            return flat(policy) if flat else {}, terrain(policy) if terrain else None

    def _keep_best(self) -> None:
        current = score(self.evaluation)
        if self.terrain:
            current += self.terrain.score()
        self.scores = [*self.scores, current][-POOLED:]
        pooled = sum(self.scores) / len(self.scores)
        if pooled < self.best_score:
            self.best_score = pooled
            self.best_networks = self.alg.networks()
            self._save_as(checkpoint.BEST)

    # --- log ------------------------------------------------------------------------------------

    def _open_log(self) -> None:
        if self.run_dir is not None and distributed.is_main():
            # After a resume, points that a lost stretch had written disappear. Only then: two
            # phases may begin in one second, whose logs readers do not take in order.
            purge = self.current_learning_iteration + 1 if self._resumed else None
            self._writer = SummaryWriter(str(self.run_dir), purge_step=purge, flush_secs=10)

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
        """Let rank 0 write everything that training depends on to `path`."""
        checkpoint.save_ranks(
            Path(path), lambda: self._content() | {"infos": infos}, self._rank_state()
        )

    def _rank_state(self) -> dict:
        """Return what differs between the ranks."""
        return {
            "learner": self.alg.world_state(),
            "env": self.env.state_dict(),
            "generators": generator_states(),
        }

    def _content(self) -> dict:
        """Return what does not."""
        policy = self.alg.policy()
        return {
            "config": config_to_dict(self.config),
            "phase": self.phase.name,
            "skills": list(self.env.skills),
            "robot": self.env.robot_identity(),
            "iteration": self.current_learning_iteration,
            "seconds": self.seconds,
            "scores": self.scores,
            "best_score": self.best_score,
            "best_networks": self.best_networks,
            "learner": self.alg.save(),
            "policy": policy.state_dict(),
            "policy_shape": policy.shape(),
            "description": self.describe_policy(),
        }

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
        """Go on from a checkpoint: exactly, with as many ranks as wrote it.

        With another number of ranks, worlds begin anew.

        Raises:
            CheckpointError: Unusable file, or one of other skills or of another robot.
        """
        fresh = self.alg.world_state()
        content, own = self._read(path)
        if content["phase"] != self.phase.name:
            raise checkpoint.CheckpointError(
                f"{path} is of the phase {content['phase']}, not of {self.phase.name}"
            )
        self._resumed = True
        self.alg.load(content["learner"], load_cfg, strict)
        self.current_learning_iteration = content["iteration"]
        self.seconds, self.best_score = content["seconds"], content["best_score"]
        self.scores = content["scores"]
        self.best_networks = content["best_networks"]
        provenance = content["description"]["provenance"]
        self.steps, self.begun_from = provenance["steps"], provenance.get("begun_from")
        if own:
            self.alg.load_world_state(own["learner"])
            self.env.load_state_dict(own["env"])
            set_generator_states(own["generators"])
        else:
            self.alg.load_world_state(fresh)
            self._tell_skill_probabilities()
            if distributed.is_main():
                _log.warning(ANEW, path, content["ranks"], distributed.size())
        return content["infos"]

    def begin_from(self, path: Path) -> None:
        """Begin this phase with the best networks in a checkpoint of the one before.

        Best by deterministic evaluation; those at the end where none was evaluated.

        Raises:
            CheckpointError: Unusable file, or one of other skills.
        """
        content, _ = self._read(path)
        self.alg.begin_from(content["best_networks"], content["learner"])
        self.seconds = content["seconds"]
        self.steps = content["description"]["provenance"]["steps"]
        self._tell_skill_probabilities()

    def _tell_skill_probabilities(self) -> None:
        if (probabilities := self.alg.skill_probabilities) is not None:
            self.env.set_skill_probabilities(probabilities)

    def _read(self, path: str | Path) -> tuple[dict, dict]:
        content, own = checkpoint.load_ranks(Path(path))
        if content["skills"] != list(self.env.skills):
            raise checkpoint.CheckpointError(
                f"{path} was trained on the skills {', '.join(content['skills'])}; the robot has "
                f"{', '.join(self.env.skills)}: mend its keyframes.yaml or start a new run"
            )
        changed = self.env.robot_change(content.get("robot", {}))
        if changed and not self.takes_changed_robot:
            raise checkpoint.CheckpointError(
                f"{path} was trained on another {self.config.robot}: {changed}; undo the change in "
                "the robot's folder, start a new run, or go on with --changed-robot"
            )
        return content, own
