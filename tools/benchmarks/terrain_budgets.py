"""What MuJoCo-Warp needs of each of its budgets on rough terrain."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from kiras_rl.envs.ground import Ground
from kiras_rl.envs.model import build_scene
from kiras_rl.envs.terrain_library import TerrainLibrary
from kiras_rl.robots.robot import Robot
from kiras_rl.schema import SimConfig

if TYPE_CHECKING:
    from kiras_rl.envs.simulation.warp import WarpSimulation

_WORLDS = 64
_EPISODES = 4
_STEPS = 60  # control steps of an episode: long enough to fall and to come to rest
_SPREAD = 2.5  # m around the centre
_REACH = 0.5  # m around a base within which no part of the robot may start in the ground


def measure_budgets(
    config: SimConfig, robot: Robot, library: TerrainLibrary
) -> dict[str, dict[str, float]]:
    """Return the largest needs by type, at the top level, and the worlds that overflowed.

    Robots fall from every orientation and move all joints at random. Memory is ample here, but for
    `max_ccd`, whose need shows only as overflows.
    """
    from kiras_rl.envs.simulation.warp import WarpSimulation

    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    scene = build_scene(robot, config.timestep, config.solver_iterations, library=library)
    sim = WarpSimulation(
        scene.model,
        _WORLDS,
        config.substeps,
        device,
        max_contacts=4 * config.max_contacts,
        max_constraints=4 * config.max_constraints,
        max_ccd=config.max_ccd,
        terrain=scene.terrain,
    )
    ground = Ground(library, _WORLDS, device)
    generator = torch.Generator().manual_seed(0)
    return {
        name: _measure(sim, ground, robot, library, kind, generator)
        for kind, name in enumerate(library.types)
    }


def _measure(
    sim: WarpSimulation,
    ground: Ground,
    robot: Robot,
    library: TerrainLibrary,
    kind: int,
    generator: torch.Generator,
) -> dict[str, float]:
    everywhere = torch.ones(_WORLDS, dtype=torch.bool, device=sim.device)
    variant = torch.arange(_WORLDS, device=sim.device) % library.variants
    tile = library.index(torch.full_like(variant, kind), library.levels - 1, variant)
    sim.write_terrain(everywhere, tile)
    ground.write(everywhere, tile)
    most = {"max_contacts": 0.0, "max_constraints": 0.0, "overflowed": 0.0}
    for _ in range(_EPISODES):
        qpos = _fallen_from_the_sky(ground, robot, generator).to(sim.device)
        hold = qpos[:, 7:]
        sim.write_state(everywhere, qpos, torch.zeros_like(sim.qvel), hold)
        for _ in range(_STEPS):
            motion = 2 * torch.rand(hold.shape, generator=generator).to(sim.device) - 1
            sim.step(hold + motion)
            need = sim.usage() | {"overflowed": float(sim.overflowed.sum())}
            most = {key: max(most[key], need[key]) for key in most}
    return most


def _fallen_from_the_sky(ground: Ground, robot: Robot, generator: torch.Generator) -> torch.Tensor:
    """Return positions above random places, in random orientations, (N, nq)."""
    qpos = torch.tensor(robot.keyframes[0].qpos).float().repeat(_WORLDS, 1)
    qpos[:, :2] = _SPREAD * (2 * torch.rand(_WORLDS, 2, generator=generator) - 1)
    around = _REACH * (2 * torch.rand(_WORLDS, 100, 2, generator=generator) - 1)
    places = (qpos[:, None, :2] + around).to(ground.tile.device)
    qpos[:, 2] += ground.heights(places).amax(dim=1).cpu()
    quat = torch.randn(_WORLDS, 4, generator=generator)
    qpos[:, 3:7] = quat / quat.norm(dim=1, keepdim=True)
    return qpos
