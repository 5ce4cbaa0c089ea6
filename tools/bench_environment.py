"""How much of bare MuJoCo's speed is left in a step of the environment, and where the rest goes."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import mujoco
import torch
from mujoco.batch import Batch

from kiras_rl.config import ConfigError
from kiras_rl.envs import make_env
from kiras_rl.envs.quadruped import QuadrupedEnv
from kiras_rl.envs.simulation.base import RANDOMISED_FIELDS
from kiras_rl.phases import FINETUNING, SKILL_LEARNING, phase_config
from kiras_rl.process import single_threaded
from kiras_rl.schema import Config, SimConfig
from kiras_rl.tools.timing import PartTimer, Times, interleave

BARE, NO_SENSORS = "mujoco.batch", "batch without sensors"
SIMULATION, ENVIRONMENT = "NativeSimulation.step", "environment step"
BARE_TERRAIN, TERRAIN = "mujoco.batch on terrain", "environment step on terrain"

ACTION_NOISE = 0.3  # as early in training, around the keyframe's pose: most robots stay up
WARM_UP = 50  # control steps after the first reset, until the robots stand

PARTS = (
    ("sim", "step", "physics"),
    ("", "step", "rewards, terminations, features"),
    ("_random", "refill", "random numbers"),
    ("", "_begin_next", "tasks and pushes"),
    ("_randomizer", "reset", "randomization"),
    ("", "_reset_worlds", "resets"),
    ("", "_observe", "observations"),
    ("", "_log", "log"),
)
"""(owner, method, part): what a step of the environment is divided into."""


@dataclass(frozen=True)
class EnvironmentTimes:
    """Seconds of a control step of all worlds.

    Attributes:
        steps: Each variant.
        parts: Each part of the environment's step.
        resets: Share of worlds that reset in a step.
    """

    steps: Times
    parts: Times
    resets: float


class Workload:
    """What every variant runs: the same worlds from the same states, under the same targets.

    Letters: T control steps, N worlds, J joints.
    """

    def __init__(self, env: QuadrupedEnv, sim: SimConfig, steps: int, seed: int) -> None:
        """Let the robots stand, then draw actions that hold each robot's keyframe, with noise."""
        self.env, self._sim = env, sim
        self._default = torch.tensor(env.robot_cfg.default_joint_pos, dtype=torch.float32)
        self._scale = torch.tensor(env.robot_cfg.action_scale, dtype=torch.float32)
        generator = torch.Generator().manual_seed(seed)
        for _ in range(WARM_UP):
            env.step(self._hold(generator))
        self.state = copy.deepcopy(env.state_dict())
        self.actions = [self._hold(generator) for _ in range(steps)]  # T x (N, J)
        clip = env.cfg.action_clip
        self.targets = [self._default + self._scale * a.clamp(-clip, clip) for a in self.actions]

    def _hold(self, generator: torch.Generator) -> torch.Tensor:
        pose = self.env.keyframes.joint_pos[self.env.task.skill]
        hold = (pose - self._default) / self._scale
        return hold + ACTION_NOISE * torch.randn(hold.shape, generator=generator)

    def bare(self, sensors: bool) -> Callable[[], float]:
        """Return a run of the batch alone, on the environment's model and its worlds' fields."""
        env, sim = self.env, self.state["sim"]
        model = copy.copy(env.sim.model)
        if not sensors:
            model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        batch = Batch(model, env.num_envs, self._sim.threads)
        for name in RANDOMISED_FIELDS:
            batch.expand(name)[:] = sim[f"field/{name}"].numpy()
        if terrain := env.scene.terrain:
            tile = self.state["tile"].numpy()
            for name, values in terrain.fields.items():
                batch.expand(name)[:, terrain.geoms] = values[tile]
        batch.set_const()
        ctrl, substeps = batch.bind("ctrl"), self._sim.substeps
        targets = [target.numpy() for target in self.targets]

        def restore() -> None:
            batch.state[:] = sim["state"].numpy()

        def step(index: int) -> None:
            ctrl[:] = targets[index]
            batch.step(nstep=substeps)

        return self._run(restore, step)

    def simulation(self) -> Callable[[], float]:
        """Return a run of the simulation behind the environment."""
        sim = self.env.sim
        return self._run(
            lambda: sim.load_state_dict(self.state["sim"]),
            lambda index: sim.step(self.targets[index]),
        )

    def environment(self) -> Callable[[], float]:
        """Return a run of the environment, resets included."""
        return self._run(self.restore, lambda index: self.env.step(self.actions[index]))

    def restore(self) -> None:
        """Put the environment back to where every run begins."""
        self.env.load_state_dict(copy.deepcopy(self.state))

    def _run(self, restore: Callable[[], None], step: Callable[[int], object]) -> Callable:
        def run() -> float:
            restore()
            begin = time.perf_counter()
            for index in range(len(self.actions)):
                step(index)
            return (time.perf_counter() - begin) / len(self.actions)

        return run


def measure_environment(config: Config, rounds: int) -> EnvironmentTimes:
    """Time the environment and what it is built on, with torch on one thread as in a rollout.

    Always the native backend on the CPU: that is what is compared.

    Raises:
        ConfigError: As `make_env`.
        RobotError: As `make_env`.
    """
    config = replace(config, sim=replace(config.sim, backend="native"))
    with single_threaded("cpu"):
        work = Workload(make_env(config), config.sim, config.learner.ppo.num_steps, config.seed)
        variants = {
            BARE: work.bare(sensors=True),
            NO_SENSORS: work.bare(sensors=False),
            SIMULATION: work.simulation(),
            ENVIRONMENT: work.environment(),
        }
        steps = interleave(variants, rounds)
        return EnvironmentTimes(steps, _measure_parts(work, rounds), _share_of_resets(work))


def measure_terrain(config: Config, rounds: int) -> Times:
    """Time the environment of finetuning, its physics alone, and the one on flat ground.

    The worlds show the tiles with which finetuning begins. Native backend, one thread of torch.

    Raises:
        ConfigError: No finetuning, or as `make_env`.
        RobotError: As `make_env`.
    """
    if config.finetuning is None:
        raise ConfigError("finetuning=null: this configuration has no terrain to measure")
    config = replace(config, sim=replace(config.sim, backend="native"))
    with single_threaded("cpu"):
        flat, rough = (
            Workload(make_env(alone), alone.sim, alone.learner.ppo.num_steps, alone.seed)
            for alone in (phase_config(config, phase) for phase in (SKILL_LEARNING, FINETUNING))
        )
        variants = {
            ENVIRONMENT: flat.environment(),
            BARE_TERRAIN: rough.bare(sensors=True),
            TERRAIN: rough.environment(),
        }
        return interleave(variants, rounds)


def _measure_parts(work: Workload, rounds: int) -> Times:
    """Time the parts in rounds of their own: the clock's calls shall not slow the comparison.

    A part that no step ran is left out.
    """
    timer, env = PartTimer(), work.env
    for owner, method, part in PARTS:
        timer.wrap(getattr(env, owner) if owner else env, method, part)
    parts: Times = {part: [] for part in timer.seconds}
    run = work.environment()
    for _ in range(rounds):
        timer.clear()
        run()
        for part, seconds in timer.seconds.items():
            parts[part].append(seconds / len(work.actions))
    timer.unwrap()
    return {part: times for part, times in parts.items() if any(times)}


def _share_of_resets(work: Workload) -> float:
    work.restore()
    ended = [work.env.step(action)[2].float().mean().item() for action in work.actions]
    return sum(ended) / len(ended)
