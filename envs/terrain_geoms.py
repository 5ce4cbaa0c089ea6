"""The geoms that stand for a tile in a model.

A model holds as many boxes as the richest tile needs and one height field. Where the boxes are, and
which asset the height field shows, are fields of the model that each world has for itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from kiras_rl.envs.terrain_library import PARKED, TerrainLibrary
from kiras_rl.envs.terrains import HALF

_GEOM = mujoco.mjtGeom
_BASE = 0.5  # m of solid ground below the lowest point of a height field
_STONE = ((0.72, 0.70, 0.66, 1.0), (0.82, 0.80, 0.76, 1.0))  # rings take turns
_SOIL = (0.56, 0.50, 0.40, 1.0)

TERRAIN_FIELDS = ("geom_pos", "geom_size", "geom_rbound", "geom_aabb", "geom_dataid")
"""Fields of MjModel that tell one tile from another."""


@dataclass(frozen=True, eq=False)
class TerrainGeoms:
    """Fields of the terrain's geoms for each of M tiles.

    Attributes:
        geoms: Which geoms of the model they are, T in a row.
        fields: TERRAIN_FIELDS, each (M, T, *shape of the field for one geom).
    """

    geoms: slice
    fields: dict[str, np.ndarray]

    def show(self, model: mujoco.MjModel, data: mujoco.MjData, tile: int) -> None:
        """Show a tile in a model of its own, as a viewer has."""
        for name, values in self.fields.items():
            getattr(model, name)[self.geoms] = values[tile]
        mujoco.mj_setConst(model, data)  # renews the bounding volumes


def add_terrain(spec: mujoco.MjSpec, library: TerrainLibrary) -> None:
    """Add a library's assets and geoms to a scene; they show no tile yet."""
    for name, rgba in (("stone", _STONE[0]), ("stone2", _STONE[1]), ("soil", _SOIL)):
        spec.add_material(name=name, rgba=rgba, specular=0.1, shininess=0.1)
    common = {"pos": PARKED, "group": 0, "contype": 1, "conaffinity": 0}
    for k in range(library.box_pos.shape[1]):
        spec.worldbody.add_geom(
            name=f"terrain/{k}",
            type=_GEOM.mjGEOM_BOX,
            size=(0.1, 0.1, 0.1),
            material="stone2" if (k + 3) // 4 % 2 else "stone",
            **common,
        )
    _add_hfields(spec, library)
    if len(library.grids) > 1:
        spec.worldbody.add_geom(
            name="terrain/ground",
            type=_GEOM.mjGEOM_HFIELD,
            hfieldname="terrain/1",
            material="soil",
            **common,
        )


def add_tile(spec: mujoco.MjSpec, library: TerrainLibrary, tile: int) -> None:
    """Add one tile to a scene for good, with no more geoms than it needs."""
    one = library.only(tile)
    add_terrain(spec, one)
    for k, (pos, size) in enumerate(zip(one.box_pos[0], one.box_size[0], strict=True)):
        geom = spec.geom(f"terrain/{k}")
        geom.pos, geom.size = pos, size
    if len(one.grids) > 1:
        spec.geom("terrain/ground").pos = (0.0, 0.0, one.grids[1].min())


def terrain_geoms(model: mujoco.MjModel, library: TerrainLibrary) -> TerrainGeoms:
    """Return the fields of every tile in a model to which `add_terrain` was applied."""
    boxes, has_ground = library.box_pos.shape[1], len(library.grids) > 1
    names = ["terrain/0"] * (boxes > 0) + ["terrain/ground"] * has_ground
    first = model.geom(names[0]).id if names else model.ngeom  # flat tiles alone need no geom
    tables = _box_fields(library)
    if has_ground:
        ground = _ground_fields(library)
        tables = {name: np.concatenate([x, ground[name]], axis=1) for name, x in tables.items()}
    return TerrainGeoms(slice(first, first + boxes + has_ground), tables)


def _add_hfields(spec: mujoco.MjSpec, library: TerrainLibrary) -> None:
    for k, grid in enumerate(library.grids[1:], start=1):
        height = max(float(np.ptp(grid)), 1e-3)  # MuJoCo refuses 0
        spec.add_hfield(
            name=f"terrain/{k}",
            nrow=len(grid),
            ncol=len(grid),
            size=(HALF, HALF, height, _BASE),
            userdata=grid.ravel().astype(np.float32),
        )


def _box_fields(library: TerrainLibrary) -> dict[str, np.ndarray]:
    pos, size = library.box_pos, library.box_size
    return {
        "geom_pos": pos,
        "geom_size": size,
        "geom_rbound": np.linalg.norm(size, axis=2),
        "geom_aabb": np.concatenate([np.zeros_like(size), size], axis=2),
        "geom_dataid": np.full(pos.shape[:2], -1),
    }


def _ground_fields(library: TerrainLibrary) -> dict[str, np.ndarray]:
    """Return the fields of the height field; MuJoCo's compiler derives them from the assets."""
    spec = mujoco.MjSpec()
    _add_hfields(spec, library)
    for k in range(1, len(library.grids)):
        spec.worldbody.add_geom(type=_GEOM.mjGEOM_HFIELD, hfieldname=f"terrain/{k}")
    probe = spec.compile()
    asset = np.maximum(library.grid - 1, 0)
    lowest = library.grids.min(axis=(1, 2))[library.grid]
    heights = np.where(library.grid > 0, lowest, PARKED[2])
    pos = np.stack([np.zeros_like(heights), np.zeros_like(heights), heights], axis=1)
    fields = {name: getattr(probe, name)[asset][:, None] for name in TERRAIN_FIELDS}
    return fields | {"geom_pos": pos[:, None]}
