"""What KiRAS costs: iterations against stock rsl-rl PPO and against itself with a part left out."""

from __future__ import annotations

import contextlib
import copy
import io
import time
from collections.abc import Callable
from dataclasses import replace
from statistics import median
from typing import TypeVar

import torch
from rich.table import Table
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from kiras_rl import interfaces as names
from kiras_rl.envs import make_env
from kiras_rl.envs.quadruped import QuadrupedEnv
from kiras_rl.models.actor import start_near_zero
from kiras_rl.phases import plan
from kiras_rl.process import single_threaded
from kiras_rl.runner import KirasRunner
from kiras_rl.schema import Config, LearnerConfig
from kiras_rl.tools.benchmarks.request import Figures, Request
from kiras_rl.tools.benchmarks.tables import make_table, verdict, with_range
from kiras_rl.tools.benchmarks.timing import (
    PartTimer,
    Times,
    interleave,
    ratios,
    summarise,
    wait_for,
)
from kiras_rl.tools.benchmarks.training import ungated

Runner = TypeVar("Runner", bound=OnPolicyRunner)

STOCK, STOCK_SINGLE = "rsl-rl PPO", "rsl-rl PPO, 1-thread rollout"
KIRAS = "KiRAS"
REMOVABLE = ("imitation", "multi_critic", "estimator", "skill_init")
"""Blocks of `learner` that null removes."""

TARGET = 1.3  # iterations of stock rsl-rl PPO


class StockView(VecEnv):
    """The environment with only the observation groups that stock PPO uses: it stores them all."""

    def __init__(self, env: QuadrupedEnv) -> None:
        """Show `env`."""
        self.env = env
        self.num_envs, self.num_actions = env.num_envs, env.num_actions
        self.max_episode_length = env.max_episode_length
        self.episode_length_buf = env.episode_length_buf
        self.device, self.cfg = env.device, env.cfg

    def get_observations(self) -> TensorDict:
        """Return the groups of stock PPO."""
        return _select(self.env.get_observations())

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        """Advance the environment."""
        obs, rewards, dones, extras = self.env.step(actions)
        return _select(obs), rewards, dones, extras


def _select(obs: TensorDict) -> TensorDict:
    return obs.select(names.PROPRIO, names.HISTORY, names.CRITIC)


def measure(request: Request) -> Figures:
    """Time iterations of every learner on one environment, from the same states.

    Raises:
        ConfigError: As `make_env`.
        RobotError: As `make_env`.
    """
    config, device = request.config, request.device
    env = make_env(config, device)
    bench = _LearningBench(env, device)
    bench.add(STOCK, lambda: _make_stock(env, config, device), _iterate_stock)
    bench.add(STOCK_SINGLE, lambda: _make_stock(env, config, device), _iterate_stock_single)
    for name, learner in _learners(config.learner).items():
        phase = plan(replace(config, learner=learner))[0]
        bench.add(name, lambda p=phase: KirasRunner(env, p, None, device), lambda r: r._iterate())
    times, updates = bench.measure(request.rounds)
    stock = min(STOCK, STOCK_SINGLE, key=lambda name: median(times[name]))
    return {
        "worlds": config.num_envs,
        "num_steps": config.learner.ppo.num_steps,
        "seconds_per_iteration": {name: summarise(t) for name, t in times.items()},
        "seconds_per_update": {name: summarise(t) for name, t in updates.items()},
        "reference": stock,
        "times_reference": {name: summarise(ratios(times, name, stock)) for name in times},
        "target": TARGET,
        "price_seconds": _prices(times),
        "rounds": {"iterations": times, "updates": updates},
    }


def _prices(times: Times) -> dict[str, float]:
    """Return how much longer an iteration with a part takes than without, the median, s."""
    return {
        part: median(a - b for a, b in zip(times[KIRAS], times[without(part)], strict=True))
        for part in REMOVABLE
        if without(part) in times
    }


def table(figures: Figures) -> list[Table]:
    """Return the comparison of learners, and the price of each part of KiRAS."""
    title = f"iterations of {figures['worlds']} worlds x {figures['num_steps']} steps"
    learners = make_table(title, "s", "update, s", "ratio", "range")
    for name, seconds in figures["seconds_per_iteration"].items():
        update = figures["seconds_per_update"][name]["median"]
        against = with_range(figures["times_reference"][name])
        learners.add_row(name, f"{seconds['median']:.3f}", f"{update:.3f}", *against)
    reached = figures["times_reference"][KIRAS]["median"]
    target = f"reference: {figures['reference']}; target: at most {figures['target']}"
    learners.caption = verdict(reached <= figures["target"], target)
    return [learners, _price_list(figures)]


def _price_list(figures: Figures) -> Table:
    whole = figures["seconds_per_iteration"][KIRAS]["median"]
    prices = make_table("price of a part of KiRAS", "s an iteration", "% of KiRAS")
    for part, seconds in figures["price_seconds"].items():
        prices.add_row(part, f"{seconds:+.3f}", f"{100 * seconds / whole:+.1f}")
    return prices


def without(part: str) -> str:
    """Return the name of KiRAS with a part left out."""
    return f"{KIRAS} without {part}"


def _learners(full: LearnerConfig) -> dict[str, LearnerConfig]:
    """Return KiRAS as configured, and without each part that it has."""
    full = ungated(full)
    present = [part for part in REMOVABLE if getattr(full, part) is not None]
    return {KIRAS: full} | {without(part): replace(full, **{part: None}) for part in present}


class _LearningBench:
    """Learners that take turns on one environment."""

    def __init__(self, env: QuadrupedEnv, device: str) -> None:
        self._env, self._device = env, device
        self._state = copy.deepcopy(env.state_dict())
        self._runs: dict[str, Callable[[], float]] = {}
        self._updates: Times = {}

    def add(
        self,
        name: str,
        make: Callable[[], Runner],
        iterate: Callable[[Runner], object],
    ) -> None:
        """Build a learner on a fresh observation: learners add groups of their own to it."""
        self._restore()
        runner, timer = make(), PartTimer()
        timer.wrap(runner.alg, "update", "update")
        self._updates[name] = []

        def run() -> float:
            self._restore()
            timer.clear()
            begin = time.perf_counter()
            iterate(runner)
            wait_for(self._device)
            seconds = time.perf_counter() - begin
            self._updates[name].append(timer.seconds["update"])
            return seconds

        self._runs[name] = run

    def measure(self, rounds: int) -> tuple[Times, Times]:
        """Return the seconds of whole iterations, and of their updates alone."""
        iterations = interleave(self._runs, rounds)
        updates = {name: times[-rounds:] for name, times in self._updates.items()}
        return iterations, updates

    def _restore(self) -> None:
        self._env.load_state_dict(copy.deepcopy(self._state))


def _iterate_stock(runner: OnPolicyRunner) -> None:
    runner.learn(1)


def _iterate_stock_single(runner: OnPolicyRunner) -> None:
    """Run stock's iteration with the thread policy of KirasRunner."""
    threads, update = torch.get_num_threads(), runner.alg.update

    def update_on_all() -> dict[str, float]:
        torch.set_num_threads(threads)
        return update()

    runner.alg.update = update_on_all
    with single_threaded(runner.device):
        runner.learn(1)
    runner.alg.update = update


def _make_stock(env: QuadrupedEnv, config: Config, device: str) -> OnPolicyRunner:
    torch.manual_seed(config.seed)
    with contextlib.redirect_stdout(io.StringIO()):  # it prints its networks
        runner = OnPolicyRunner(StockView(env), _stock_config(config.learner), None, device)
    # Like the actor of KiRAS, so that the robots move alike and the physics costs the same
    start_near_zero(runner.alg.actor.mlp)
    return runner


def _stock_config(learner: LearnerConfig) -> dict:
    """Return rsl-rl's dictionary: what KiRAS has in common with PPO is the same."""
    ppo = learner.ppo
    same = ("num_mini_batches", "gamma", "lam", "clip_param", "value_loss_coef")
    same += ("max_grad_norm", "learning_rate")
    std = ppo.action_std[0][1]
    noise = {"class_name": "GaussianDistribution", "init_std": std, "std_type": "log"}
    network = {"class_name": "MLPModel", "activation": "elu", "obs_normalization": False}
    return {
        "algorithm": {
            "class_name": "PPO",
            "num_learning_epochs": ppo.num_epochs,
            "desired_kl": ppo.desired_kl[0][1],
            **{key: getattr(ppo, key) for key in same},
        },
        "actor": {**network, "hidden_dims": list(ppo.actor_dims), "distribution_cfg": noise},
        "critic": {**network, "hidden_dims": list(ppo.critic_dims)},
        "obs_groups": {"actor": [names.PROPRIO, names.HISTORY], "critic": [names.CRITIC]},
        "num_steps_per_env": ppo.num_steps,
        "save_interval": 1,  # never used: nothing is written without a log folder
    }
