"""Speed and error of the search for contacts with height fields.

All other pairs of these robots have closed forms. The robot is put on random places of the rough
tiles with random joint angles, and its contacts are compared with those of a search that converges.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from time import perf_counter

import mujoco
import numpy as np
from rich.table import Table

from kiras_rl.config import ConfigError
from kiras_rl.envs.model import Scene, build_scene
from kiras_rl.envs.terrain_library import TerrainLibrary, build_library
from kiras_rl.envs.terrains import HALF
from kiras_rl.phases import FINETUNING, finetuning_terrain, phase_of
from kiras_rl.robots.robot import Robot, load_robot
from kiras_rl.tools.benchmarks.request import Figures, Request
from kiras_rl.tools.benchmarks.tables import make_table
from kiras_rl.tools.benchmarks.timing import interleave, ratios, summarise

POSES = 400
JOINT_NOISE = 0.3  # rad, 1 sigma
SEED = 1
CHOICE, REFERENCE = "configuration", "reference"
VARIANTS = {
    "tolerance 1e-5": (35, 1e-5),
    "tolerance 1e-4": (35, 1e-4),
    "tolerance 1e-3": (35, 1e-3),
    "20 iterations": (20, 1e-6),
    "12 iterations": (12, 1e-6),
    "8 iterations": (8, 1e-6),
    "6 iterations": (6, 1e-6),
    "12 iterations, tolerance 1e-4": (12, 1e-4),
    REFERENCE: (200, 1e-12),
}
"""Name -> (iterations, tolerance in m)."""


@dataclass(frozen=True)
class Pose:
    """A robot on a tile; `qpos` (nq,)."""

    tile: int
    qpos: np.ndarray


def measure(request: Request) -> Figures:
    """Collide all poses under every setting, in turns.

    Raises:
        ConfigError: No finetuning or no terrain in it, or flat tiles alone, which have no height
            field.
        RobotError: No such robot.
    """
    if request.config.finetuning is None:
        raise ConfigError("finetuning=null: this configuration has no terrain to measure")
    config = phase_of(request.config, FINETUNING).config
    robot, library = load_robot(config.robot), build_library(finetuning_terrain(request.config))
    if not (library.grid > 0).any():
        raise ConfigError(
            "finetuning.env.terrain.types: none has a height field, which these settings are for; "
            "all but flat have one"
        )
    scene = build_scene(robot, config.sim.timestep, config.sim.solver_iterations, library=library)
    option, poses = scene.model.opt, _draw(robot, library)
    settings = {CHOICE: (int(option.ccd_iterations), float(option.ccd_tolerance)), **VARIANTS}
    contacts = {name: _collide(scene, poses, *setting)[0] for name, setting in settings.items()}
    times = interleave(
        {name: _timed(scene, poses, setting) for name, setting in settings.items()}, request.rounds
    )
    return {
        "robot": robot.name,
        "poses": len(poses),
        "contacts": sum(map(len, contacts[REFERENCE])),
        "settings": settings,
        "errors": {n: _differences(found, contacts[REFERENCE]) for n, found in contacts.items()},
        "seconds_per_pose": {name: median(seconds) for name, seconds in times.items()},
        "speed": {name: summarise(ratios(times, CHOICE, name)) for name in times},
    }


def _draw(robot: Robot, library: TerrainLibrary) -> list[Pose]:
    rng = np.random.default_rng(SEED)
    rough, poses = np.flatnonzero(library.grid > 0), []
    height = robot.keyframes[0].base_height
    for tile in rng.choice(rough, POSES):
        grid, place = library.grids[library.grid[tile]], rng.uniform(-0.8, 0.8, 2)
        column, row = ((place + 1.0) / 2.0 * (len(grid) - 1)).round().astype(int)
        joints = robot.default_joint_pos + rng.normal(0.0, JOINT_NOISE, len(robot.joint_names))
        base = (*(HALF * place), grid[row, column] + height)
        poses.append(Pose(int(tile), np.array([*base, 1.0, 0.0, 0.0, 0.0, *joints])))
    return poses


def _collide(
    scene: Scene, poses: list[Pose], iterations: int, tolerance: float
) -> tuple[list[np.ndarray], float]:
    """Return distance and normal of every contact with the height field, and the seconds it took.

    The contacts of a pose are (C, 4).
    """
    model, data, tiles = scene.model, mujoco.MjData(scene.model), scene.terrain
    assert tiles is not None
    model.opt.ccd_iterations, model.opt.ccd_tolerance = iterations, tolerance
    ground, found, seconds = model.geom("terrain/ground").id, [], 0.0
    for pose in poses:
        tiles.show(model, data, pose.tile)
        data.qpos[:] = pose.qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        begin = perf_counter()
        mujoco.mj_collision(model, data)
        seconds += perf_counter() - begin
        on_ground = (data.contact.geom == ground).any(axis=1)
        dist, frame = data.contact.dist[on_ground], data.contact.frame[on_ground]
        found.append(np.column_stack([dist, frame[:, :3]]))
    return found, seconds


def _timed(scene: Scene, poses: list[Pose], setting: tuple[int, float]) -> Callable[[], float]:
    return lambda: _collide(scene, poses, *setting)[1] / len(poses)


def _differences(found: list[np.ndarray], truth: list[np.ndarray]) -> dict[str, float]:
    """Return errors of the contacts where as many were found as there are; depths in m."""
    pairs = [(a, b) for a, b in zip(found, truth, strict=True) if len(a) == len(b)]
    mine, true = (np.concatenate(column) for column in zip(*pairs, strict=True))
    depth = np.abs(mine[:, 0] - true[:, 0])
    cosine = (mine[:, 1:] * true[:, 1:]).sum(axis=1).clip(-1.0, 1.0)
    return {
        "depth_mean": float(depth.mean()),
        "depth_max": float(depth.max()),
        "normal_mean": float(np.degrees(np.arccos(cosine)).mean()),
        "poses_with_other_contacts": len(truth) - len(pairs),
    }


def table(figures: Figures) -> list[Table]:
    """Return speed and errors of every setting; a * marks what the environment has."""
    columns = (
        "iterations",
        "tolerance",
        "speed",
        "depth, um",
        "at most, um",
        "normal, deg",
        "other",
    )
    title = f"contacts with height fields: {figures['contacts']} of {figures['poses']} poses"
    rows = make_table(f"{title}, {figures['robot']}", *columns)
    for name, errors in figures["errors"].items():
        iterations, tolerance = figures["settings"][name]
        rows.add_row(
            f"* {name}" if name == CHOICE else name,
            str(iterations),
            f"{tolerance:g}",
            f"{figures['speed'][name]['median']:.2f}",
            f"{1e6 * errors['depth_mean']:.2f}",
            f"{1e6 * errors['depth_max']:.1f}",
            f"{errors['normal_mean']:.3f}",
            str(errors["poses_with_other_contacts"]),
        )
    rows.caption = "other: poses with more or fewer contacts than the reference; left out before"
    return [rows]
