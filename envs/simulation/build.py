"""Choosing the physics backend."""

from __future__ import annotations

import torch

from kiras_rl.envs.model import Scene
from kiras_rl.envs.simulation.base import Simulation
from kiras_rl.schema import SimConfig


def make_simulation(
    scene: Scene,
    config: SimConfig,
    num_worlds: int,
    backend: str,
    device: torch.device,
    fields: tuple[str, ...] = (),
) -> Simulation:
    """Build the worlds of a scene.

    Args:
        scene: The compiled model and what its terrain needs.
        config: Threads, substeps and memory.
        num_worlds: How many.
        backend: "native" or "warp".
        device: Where the tensors live.
        fields: Of MjModel, to hold one value a world beside RANDOMISED_FIELDS.
    """
    if backend == "native":
        from kiras_rl.envs.simulation.native import NativeSimulation

        return NativeSimulation(
            scene.model, num_worlds, config.substeps, config.threads, scene.terrain, fields
        )
    # Imported late: it takes seconds, and a CPU user never needs it.
    from kiras_rl.envs.simulation.warp import WarpSimulation

    return WarpSimulation(
        scene.model,
        num_worlds,
        config.substeps,
        device,
        max_contacts=config.max_contacts,
        max_constraints=config.max_constraints,
        max_ccd=config.max_ccd,
        terrain=scene.terrain,
        fields=fields,
    )
