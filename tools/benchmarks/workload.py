"""Control steps that every variant repeats: the same worlds, states and targets."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch

from kiras_rl.envs.quadruped import QuadrupedEnv
from kiras_rl.envs.simulation.base import RANDOMISED_FIELDS
from kiras_rl.envs.simulation.native import NativeSimulation
from kiras_rl.schema import SimConfig
from kiras_rl.tools.benchmarks.timing import wait_for

ACTION_NOISE = 0.3  # as early in training, around the keyframe's pose: most robots stay up
WARM_UP = 50  # control steps after the first reset, until the robots stand

ENVIRONMENT_PARTS = (
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


class Workload:
    """Control steps of one environment, from where its robots stand.

    Letters: T control steps, N worlds, J joints.
    """

    def __init__(self, env: QuadrupedEnv, sim: SimConfig, steps: int, seed: int) -> None:
        """Let the robots stand, then draw actions that hold each robot's keyframe, with noise."""
        self.env, self._sim = env, sim
        robot, device = env.robot_cfg, env.device
        self._default = torch.tensor(robot.default_joint_pos, dtype=torch.float32, device=device)
        self._scale = torch.tensor(robot.action_scale, dtype=torch.float32, device=device)
        generator = torch.Generator(device=device).manual_seed(seed)
        for _ in range(WARM_UP):
            env.step(self._hold(generator))
        self.state = copy.deepcopy(env.state_dict())
        self.actions = [self._hold(generator) for _ in range(steps)]  # T x (N, J)
        clip = env.cfg.action_clip
        self.targets = [self._default + self._scale * a.clamp(-clip, clip) for a in self.actions]

    def _hold(self, generator: torch.Generator) -> torch.Tensor:
        pose = self.env.keyframes.joint_pos[self.env.task.skill]
        hold = (pose - self._default) / self._scale
        noise = torch.randn(hold.shape, generator=generator, device=hold.device)
        return hold + ACTION_NOISE * noise

    def bare(self, sensors: bool = True) -> Callable[[], float]:
        """Return a run of the library behind the environment alone."""
        steps = bare_steps if isinstance(self.env.sim, NativeSimulation) else bare_warp_steps
        return steps(self.env, self.state, self.targets, self._sim, sensors)

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
        return timed_steps(restore, step, len(self.actions), self.env.device)


def bare_steps(
    env: QuadrupedEnv,
    state: dict,
    targets: list[torch.Tensor],
    sim: SimConfig,
    sensors: bool = True,
) -> Callable[[], float]:
    """Return a run of `mujoco.batch` alone: an environment's model and its worlds' fields.

    Args:
        env: Of the native backend.
        state: Its `state_dict` where the run begins.
        targets: Position targets of each control step, T x (N, J), rad.
        sim: Threads and physics steps of a control step.
        sensors: Whether the sensors that the environment reads are computed.

    Returns:
        A function that runs once and returns the seconds of a control step.
    """
    model = copy.copy(env.sim.model)
    if not sensors:
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
    batch = Batch(model, env.num_envs, sim.threads)
    for name in RANDOMISED_FIELDS:
        batch.expand(name)[:] = state["sim"][f"field/{name}"].numpy()
    if terrain := env.scene.terrain:
        tile = state["tile"].numpy()
        for name, values in terrain.fields.items():
            batch.expand(name)[:, terrain.geoms] = values[tile]
    batch.set_const()
    ctrl, begin = batch.bind("ctrl"), state["sim"]["state"].numpy()
    arrays: list[np.ndarray] = [target.numpy() for target in targets]

    def restore() -> None:
        batch.state[:] = begin

    def step(index: int) -> None:
        ctrl[:] = arrays[index]
        batch.step(nstep=sim.substeps)

    return timed_steps(restore, step, len(targets), env.device)


def bare_warp_steps(
    env: QuadrupedEnv,
    state: dict,
    targets: list[torch.Tensor],
    sim: SimConfig,
    sensors: bool = True,
) -> Callable[[], float]:
    """Return a run of `mujoco_warp` alone, as its documentation has it: steps in one graph.

    The same model, contact sensors of MuJoCo's own included, its worlds' fields, and no terrain;
    arguments as those of `bare_steps`.
    """
    import mujoco_warp as mjw
    import warp as wp

    from kiras_rl.envs.simulation.warp import Launches

    device = wp.get_device(str(env.device))
    model = copy.copy(env.sim.model)
    if not sensors:
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
    with wp.ScopedDevice(device):
        n = env.num_envs
        m = mjw.put_model(model, batch_sizes=dict.fromkeys(RANDOMISED_FIELDS, n))
        m.opt.warn_overflow = 0
        memory = {"nconmax": sim.max_contacts, "njmax": sim.max_constraints}
        data = mjw.make_data(model, n, **memory)
        begin = {
            name: state["sim"][name] for name in ("time", "qpos", "qvel", "ctrl", "qacc_warmstart")
        }
        if "history" in state["sim"]:
            begin["history"] = state["sim"]["history"].flatten(1)
        bound = {name: wp.to_torch(getattr(data, name)) for name in begin}
        for name in RANDOMISED_FIELDS:
            wp.to_torch(getattr(m, name)).copy_(state["sim"][f"field/{name}"])

    def launch() -> None:
        for _ in range(sim.substeps):
            mjw.step(m, data)

    wp.synchronize_device(device)  # torch continues on a stream of its own
    control_step = Launches(launch, device, capture=True)

    def restore() -> None:
        for name, values in begin.items():
            bound[name].copy_(values)

    def step(index: int) -> None:
        bound["ctrl"].copy_(targets[index])
        control_step()

    return timed_steps(restore, step, len(targets), env.device)


def timed_steps(
    restore: Callable[[], None], step: Callable[[int], object], count: int, device: torch.device
) -> Callable[[], float]:
    """Return a function that restores, steps `count` times and returns the seconds of a step."""

    def run() -> float:
        restore()
        wait_for(device)
        begin = time.perf_counter()
        for index in range(count):
            step(index)
        wait_for(device)
        return (time.perf_counter() - begin) / count

    return run
