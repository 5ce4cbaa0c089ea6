"""What MuJoCo's options cost in speed and in accuracy, on the motions that a policy makes.

All variants begin in the same states and follow the same targets, recorded from the policy that
comes with the robot while it walks in all its skills. The loop is open: a policy would correct what
differs, and the error would be its, not the physics'. The reference is the same model with a
short time step, elliptic cones and a solver that converges.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from statistics import median
from typing import Any

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from rich.table import Table

from kiras_rl.config import ConfigError
from kiras_rl.envs import rotations
from kiras_rl.envs.model import Scene, build_scene
from kiras_rl.evaluation.flat import walk
from kiras_rl.phases import plan
from kiras_rl.process import single_threaded
from kiras_rl.robots.robot import Robot, load_robot
from kiras_rl.schema import Config
from kiras_rl.tools.benchmarks.request import Figures, Request, native
from kiras_rl.tools.benchmarks.tables import make_table
from kiras_rl.tools.benchmarks.timing import interleave, ratios, summarise
from kiras_rl.tools.benchmarks.workload import timed_steps
from kiras_rl.tools.evaluation.evaluator import (
    evaluation_physics,
    make_evaluation_env,
    onboard_policy,
    trained_config,
)
from kiras_rl.tools.shared.policy_files import load_policy

CHOICE, REFERENCE = "configuration", "reference"
SETTLE = 2.0  # s of walking before the states are taken
TIMES = (0.1, 0.5)  # s after which the errors are taken
COMMANDS = (0.2, 0.5)  # v_x, spread over the worlds, m/s

_REFERENCE_TIMESTEP, _REFERENCE_ITERATIONS = 0.001, 100
_EXACT = 1e-12  # tolerance with which the reference's solver stops


@dataclass(frozen=True)
class Options:
    """What is varied; `condim` is that of the feet, `substeps` those of a control step."""

    cone: str
    iterations: int
    ls_iterations: int
    condim: int
    substeps: int
    impratio: float
    integrator: str
    tolerance: float

    @classmethod
    def of(cls, scene: Scene, robot: Robot, substeps: int) -> Options:
        """Read those of a scene."""
        option = scene.model.opt
        return cls(
            cone=mujoco.mjtCone(option.cone).name.removeprefix("mjCONE_").lower(),
            iterations=int(option.iterations),
            ls_iterations=int(option.ls_iterations),
            condim=int(scene.model.geom(robot.foot_geoms[0]).condim[0]),
            substeps=substeps,
            impratio=float(option.impratio),
            integrator=mujoco.mjtIntegrator(option.integrator).name.removeprefix("mjINT_").lower(),
            tolerance=float(option.tolerance),
        )

    def apply(self, scene: Scene, robot: Robot, step_dt: float) -> None:
        """Write them into a scene."""
        option, model = scene.model.opt, scene.model
        option.cone = getattr(mujoco.mjtCone, f"mjCONE_{self.cone.upper()}")
        option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{self.integrator.upper()}")
        option.timestep = step_dt / self.substeps
        option.iterations, option.ls_iterations = self.iterations, self.ls_iterations
        option.impratio, option.tolerance = self.impratio, self.tolerance
        for foot in robot.foot_geoms:
            model.geom(foot).condim = self.condim


@dataclass(frozen=True)
class Motions:
    """N robots that walk, for T control steps.

    Attributes:
        qpos: Where they begin, (N, nq).
        qvel: (N, nv).
        targets: Position targets, (T, N, J), rad.
        step_dt: Duration of a control step, s.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    targets: np.ndarray
    step_dt: float


def measure(request: Request) -> Figures:
    """Time every variant in turns, and compare its motions with the reference's.

    Raises:
        ConfigError: A configuration that the robot's policy does not fit.
        PolicyError: No policy comes with the robot.
        RobotError: No such robot.
    """
    config, robot = native(request.config), load_robot(request.config.robot)
    motions = record_motions(config)
    scene = _scene(config, robot)
    chosen = Options.of(scene, robot, config.sim.substeps)
    variants = _variants(chosen, motions.step_dt)
    runs = {name: _Run(config, robot, options, motions) for name, options in variants.items()}
    truth = runs[REFERENCE].outcome()
    errors = {name: _differences(run.outcome(), truth, robot) for name, run in runs.items()}
    times = interleave({name: run.timed() for name, run in runs.items()}, request.rounds)
    return {
        "robot": robot.name,
        "worlds": len(motions.qpos),
        "step_dt": motions.step_dt,
        "times": list(TIMES),
        "options": {name: asdict(options) for name, options in variants.items()},
        "seconds_per_step": {name: summarise(seconds) for name, seconds in times.items()},
        "steps_per_second": {n: len(motions.qpos) / median(s) for n, s in times.items()},
        "speed": {name: summarise(ratios(times, CHOICE, name)) for name in times},
        "errors": errors,
        "rounds": times,
    }


@torch.no_grad()
def record_motions(config: Config) -> Motions:
    """Walk with the policy that comes with the robot, in all its skills, on nominal physics.

    Robots that fell on the way are left out.

    Raises:
        ConfigError: The policy does not say how it was trained.
        PolicyError: No policy comes with the robot.
    """
    policy = load_policy(None, config.robot)
    trained = plan(trained_config(policy.metadata))[0].config
    trained = replace(evaluation_physics(native(trained), nominal=True), sim=config.sim)
    env = make_evaluation_env(trained, config.num_envs, SETTLE + max(TIMES))
    worlds = torch.arange(env.num_envs)
    command = torch.zeros(env.num_envs, 3)
    command[:, 0] = torch.linspace(*COMMANDS, env.num_envs)
    targets, simulate = [], env.sim.step

    def step(ctrl: torch.Tensor) -> None:
        targets.append(ctrl.numpy().copy())
        simulate(ctrl)

    env.sim.step = step
    settle, count = round(SETTLE / env.step_dt), round(max(TIMES) / env.step_dt)
    with single_threaded("cpu"):
        duration = SETTLE + max(TIMES)
        motion = walk(env, onboard_policy(policy), duration, worlds % len(env.skills), command)
        for _ in range(settle):
            next(motion)
        begin = env.sim.qpos.numpy().copy(), env.sim.qvel.numpy().copy()
        *_, (_, alive) = motion
    keep = alive.numpy()
    if not keep.any():
        raise ConfigError(f"the policy of {config.robot} falls in all worlds: nothing to compare")
    qpos, qvel = (state[keep] for state in begin)
    return Motions(qpos, qvel, np.stack(targets[settle : settle + count])[:, keep], env.step_dt)


def _variants(chosen: Options, step_dt: float) -> dict[str, Options]:
    """Return the configuration's options, then one of them changed at a time, then the reference.

    What is the configuration's own is not repeated.
    """
    k = chosen.substeps
    changes: list[dict[str, Any]] = [
        *({"cone": cone} for cone in ("pyramidal", "elliptic")),
        *({"iterations": count} for count in (2, 3, 4, 6, 10, 20)),
        *({"tolerance": tolerance} for tolerance in (1e-8, 1e-6, 1e-5, 1e-4)),
        *({"ls_iterations": count} for count in (4, 6, 10, 20)),
        *({"condim": dimensions} for dimensions in (3, 4, 6)),
        *({"substeps": count} for count in (k, k + 1, 2 * k)),
        *({"impratio": ratio} for ratio in (1, 10)),
        *({"integrator": name} for name in ("euler", "implicit", "implicitfast")),
        {"cone": "elliptic", "impratio": 10},
        {"cone": "elliptic", "impratio": 10, "condim": 6, "ls_iterations": 20},
    ]
    varied = {_named(change, step_dt): replace(chosen, **change) for change in changes}
    variants = {name: options for name, options in varied.items() if options != chosen}
    exact = replace(
        chosen,
        cone="elliptic",
        iterations=_REFERENCE_ITERATIONS,
        ls_iterations=_REFERENCE_ITERATIONS,
        substeps=round(step_dt / _REFERENCE_TIMESTEP),
        tolerance=_EXACT,
    )
    return {CHOICE: chosen} | variants | {REFERENCE: exact}


_NAMES = {"ls_iterations": "line search iterations", "condim": "condim of the feet"}


def _named(change: dict[str, Any], step_dt: float) -> str:
    words = {_NAMES.get(name, name): value for name, value in change.items()}
    if substeps := words.pop("substeps", None):
        words["timestep"] = f"{step_dt / substeps:g} s x {substeps}"
    return ", ".join(f"{name} {value}" for name, value in words.items())


def _scene(config: Config, robot: Robot) -> Scene:
    return build_scene(robot, config.sim.timestep, config.sim.solver_iterations)


class _Run:
    """The motions under one set of options."""

    def __init__(self, config: Config, robot: Robot, options: Options, motions: Motions) -> None:
        self._motions, self._substeps = motions, options.substeps
        self._scene = _scene(config, robot)
        options.apply(self._scene, robot, motions.step_dt)
        self._feet = [self._scene.model.geom(foot).id for foot in robot.foot_geoms]
        self._batch = Batch(self._scene.model, len(motions.qpos), config.sim.threads)
        self._batch.reset(stage=int(mujoco.mjtStage.mjSTAGE_NONE))
        self._begin = self._batch.state.copy()
        self._ctrl = self._batch.bind("ctrl")

    def _restore(self) -> None:
        self._batch.state[:] = self._begin
        self._batch.bind("qpos")[:] = self._motions.qpos
        self._batch.bind("qvel")[:] = self._motions.qvel

    def timed(self) -> Callable[[], float]:
        """Return a function that runs the motions and returns the seconds of a control step."""

        def step(index: int) -> None:
            self._ctrl[:] = self._motions.targets[index]
            self._batch.step(nstep=self._substeps)

        count = len(self._motions.targets)
        return timed_steps(self._restore, step, count, torch.device("cpu"))

    def outcome(self) -> dict[str, np.ndarray]:
        """Run once.

        Returns:
            qpos: After each control step, (T, N, nq).
            foot_force: Mean over each control step, (T, N, F, 3), N.
            foot_height: Lowest over each control step, of the feet's centres, (T, N, F), m.
        """
        self._restore()
        forces = self._scene.sensors.foot_force_w
        steps = []
        for target in self._motions.targets:
            self._ctrl[:] = target
            record = self._batch.rollout(self._substeps, record=["qpos", "sensordata", "geom_xpos"])
            force = record["sensordata"][..., forces].mean(axis=1)
            height = record["geom_xpos"][:, :, self._feet, 2].min(axis=1)
            steps.append((record["qpos"][:, -1], force.reshape(*height.shape, 3), height))
        names = ("qpos", "foot_force", "foot_height")
        return {
            n: np.stack(column) for n, column in zip(names, zip(*steps, strict=True), strict=True)
        }


def _differences(
    outcome: dict[str, np.ndarray], truth: dict[str, np.ndarray], robot: Robot
) -> dict[str, list[float] | float]:
    """Return mean differences after each of TIMES, and how deep the feet sink, in SI units."""
    count = len(truth["qpos"])
    rows = [round(time / max(TIMES) * count) - 1 for time in TIMES]
    base = (outcome["qpos"] - truth["qpos"])[rows, :, :3]
    pitch = _pitch(outcome["qpos"][rows]) - _pitch(truth["qpos"][rows])
    force = (outcome["foot_force"] - truth["foot_force"])[rows]
    sunk = (robot.foot_radius - outcome["foot_height"]).max(axis=(0, 2))  # of each world
    return {
        "base_position": np.linalg.norm(base, axis=-1).mean(axis=1).tolist(),
        "base_height": np.abs(base[..., 2]).mean(axis=1).tolist(),
        "pitch": np.abs(pitch).mean(axis=1).tolist(),
        "foot_force": np.linalg.norm(force, axis=-1).mean(axis=(1, 2)).tolist(),
        "penetration": float(np.maximum(sunk, 0.0).mean()),
    }


def _pitch(qpos: np.ndarray) -> np.ndarray:
    """Return the pitch of (T, N, nq), (T, N), rad."""
    quat = torch.from_numpy(qpos[..., 3:7].reshape(-1, 4))
    pitch = rotations.roll_pitch(rotations.projected_gravity(rotations.matrix(quat)))[:, 1]
    return pitch.numpy().reshape(qpos.shape[:2])


_COLUMNS = (("base_position", "base, mm", 1e3), ("base_height", "height, mm", 1e3))
_COLUMNS += (("pitch", "pitch, deg", 180 / np.pi), ("foot_force", "foot force, N", 1.0))
"""(error, heading, factor)."""


def table(figures: Figures) -> list[Table]:
    """Return speed and errors of each variant; a * marks the configuration's choice."""
    when = " and ".join(f"{time:g} s" for time in figures["times"])
    title = f"{figures['worlds']} {figures['robot']} that walk, errors after {when}"
    columns = ("env steps/s", "speed", *(heading for _, heading, _ in _COLUMNS), "feet sink, mm")
    rows = make_table(f"options of MuJoCo: {title}", *columns)
    rows.columns[0].no_wrap = False
    for name, errors in figures["errors"].items():
        differences = [
            " / ".join(f"{factor * value:.2f}" for value in errors[key])
            for key, _, factor in _COLUMNS
        ]
        rows.add_row(
            f"* {name}" if name == CHOICE else name,
            f"{figures['steps_per_second'][name]:,.0f}",
            f"{figures['speed'][name]['median']:.2f}",
            *differences,
            f"{1e3 * errors['penetration']:.2f}",
        )
    rows.caption = f"* {_describe(figures, CHOICE)}\n{REFERENCE}: {_describe(figures, REFERENCE)}"
    return [rows]


def _describe(figures: Figures, name: str) -> str:
    options = figures["options"][name]
    named = ((field.name, options[field.name]) for field in fields(Options))
    return ", ".join(f"{key} {value}" for key, value in named)
