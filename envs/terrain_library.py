"""All tiles of a configuration as tables. A tile is a number: `index(type, level, variant)`."""

from __future__ import annotations

import inspect
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar, overload

import numpy as np

from kiras_rl.config import ConfigError
from kiras_rl.envs import terrains
from kiras_rl.envs.lookup import find_function
from kiras_rl.envs.relief import SINK, ground_grid
from kiras_rl.envs.terrains import HALF, Draw, Tile, side_bounds
from kiras_rl.schema import TerrainConfig

if TYPE_CHECKING:  # a viewer of policies does without
    import torch

MAX_BOXES = 48
"""Boxes of a tile at most: more cost too much in MuJoCo-Warp, which compares all with all."""

_KEY = "env.terrain"
_FOOT = 0.3  # m that boxes reach below the floor: no robot gets to their underside
_PARKED_SIZE = (0.1, 0.1, 0.1)  # m

PARKED = (0.0, 0.0, -50.0)
"""Where geoms lie that a tile does not need, m."""

Index = TypeVar("Index", np.ndarray, "torch.Tensor")  # of integers


@dataclass(frozen=True, eq=False)
class TerrainLibrary:
    """M tiles. Letters: R rings, B boxes, K grids of G x G points.

    Attributes:
        types: Names in the order of the configuration.
        proportions: Share of each type, sums to 1, (T,).
        levels: Levels of difficulty.
        variants: Tiles of a type and level.
        cell: Distance of the points of a grid, m.
        edges: Outer half widths of the rings, (M, R), m; infinite after the last.
        tops: Heights of their sides E, W, N, S, (M, R, 4), m; 0 after the last.
        grid: Which of `grids` is the ground, (M,); 0 for none.
        grids: Heights [y, x] from -HALF to HALF, (K, G, G), m; below 0 the floor hides them.
            Grid 0 lies below the floor.
        box_pos: Centres, (M, B, 3), m.
        box_size: Half sizes, (M, B, 3), m.
        spawn_height: Height of the platform, (M,), m.
    """

    types: tuple[str, ...]
    proportions: np.ndarray
    levels: int
    variants: int
    cell: float
    edges: np.ndarray
    tops: np.ndarray
    grid: np.ndarray
    grids: np.ndarray
    box_pos: np.ndarray
    box_size: np.ndarray
    spawn_height: np.ndarray

    @property
    def size(self) -> int:
        """Number of tiles, M."""
        return len(self.grid)

    @overload
    def index(self, kind: int, level: int, variant: int) -> int: ...

    @overload
    def index(self, kind: Index | int, level: Index | int, variant: Index | int) -> Index: ...

    def index(self, kind: Any, level: Any, variant: Any) -> Any:
        """Return the numbers of tiles from the numbers of their type, level and variant."""
        return (kind * self.levels + level) * self.variants + variant

    def only(self, tile: int) -> TerrainLibrary:
        """Return the tables of one tile, without padding."""
        own = slice(tile, tile + 1)
        boxes = int((self.box_pos[tile, :, 2] != PARKED[2]).sum())
        grid = self.grid[own]
        return replace(
            self,
            edges=self.edges[own],
            tops=self.tops[own],
            grid=np.minimum(grid, 1),
            grids=self.grids[np.unique([0, *grid])],
            box_pos=self.box_pos[own, :boxes],
            box_size=self.box_size[own, :boxes],
            spawn_height=self.spawn_height[own],
        )


def build_library(config: TerrainConfig) -> TerrainLibrary:
    """Make every tile of a configuration.

    A tile depends on its own type's parameters and on `seed`, not on the other types.

    Raises:
        ConfigError: An unknown type or parameter, or a shape that cannot be.
    """
    cells = 2 * HALF / config.cell
    if abs(cells - round(cells)) > 1e-6:
        raise ConfigError(
            f"{_KEY}.cell={config.cell:g}: a tile of {2 * HALF:g} m has to be a whole number of "
            "cells, as with 0.1"
        )
    types = {name: values for name, values in config.types.items() if values is not None}
    tiles, reliefs = [], []
    for name, values in types.items():
        make = _bind(name, values)
        for level in range(config.levels):
            for variant in range(config.variants):
                rng = np.random.default_rng(
                    [config.seed, zlib.crc32(name.encode()), level, variant]
                )
                draw = Draw(level / max(config.levels - 1, 1), config.scale, variant % 2 == 1, rng)
                tiles.append(_make(name, make, draw))
                reliefs.append(ground_grid(tiles[-1], draw, config))
    proportions = _proportions(types)
    boxes = [_boxes(tile) for tile in tiles]
    return TerrainLibrary(
        types=tuple(types),
        proportions=proportions,
        levels=config.levels,
        variants=config.variants,
        cell=config.cell,
        **_ring_tables(tiles),
        **_grid_tables(reliefs, config),
        **_box_tables(boxes),
        spawn_height=np.array([_centre(t, g) for t, g in zip(tiles, reliefs, strict=True)]),
    )


def _bind(name: str, values: dict) -> Callable[[Draw], Tile]:
    """Look a type up and check the keys of its entry."""
    where = f"{_KEY}.types.{name}"
    function = find_function(vars(terrains), name, Draw, where=f"{_KEY}.types")
    if not isinstance(values, dict):
        raise ConfigError(f"{where}: give a proportion, as in {name}: {{proportion: 0.2}}")
    parameters = {key: value for key, value in values.items() if key != "proportion"}
    allowed = list(inspect.signature(function).parameters)[1:]
    unknown = [key for key in parameters if key not in allowed]
    if unknown or "proportion" not in values:
        problem = f"unknown parameter '{unknown[0]}'" if unknown else "no proportion"
        raise ConfigError(f"{where}: {problem}; it takes {', '.join(['proportion', *allowed])}")
    missing = [key for key in allowed if key not in parameters]
    if missing:
        raise ConfigError(f"{where}: no '{missing[0]}'; it takes {', '.join(allowed)}")
    return partial(function, **parameters)


def _make(name: str, make: Callable[[Draw], Tile], draw: Draw) -> Tile:
    try:
        tile = make(draw)
    except ValueError as error:
        raise ConfigError(f"{_KEY}.types.{name}: {error}") from None
    count = len(_boxes(tile)[0])
    if count > MAX_BOXES:
        raise ConfigError(
            f"{_KEY}.types.{name}: {count} boxes a tile, {MAX_BOXES} are allowed: "
            "put its rings farther apart"
        )
    return tile


def _proportions(types: dict[str, dict]) -> np.ndarray:
    shares = np.array([values["proportion"] for values in types.values()], dtype=float)
    if not len(shares) or (shares < 0).any() or shares.sum() <= 0:
        raise ConfigError(f"{_KEY}.types: the proportions have to be positive, one at least")
    return shares / shares.sum()


def _boxes(tile: Tile) -> tuple[np.ndarray, np.ndarray]:
    """Return centres and half sizes of what is higher than the floor, (b, 3) each."""
    inner = np.concatenate([[0.0], tile.edges])[:-1]
    spans = []
    for i, o, tops in zip(inner, tile.edges, tile.tops, strict=True):
        if i == 0.0:  # the platform is one box
            spans.append((-o, o, -o, o, tops[0]))
            continue
        spans += [(*side, top) for side, top in zip(side_bounds(i, o), tops, strict=True)]
    west, east, south, north, top = np.array(spans).reshape(-1, 5).T
    low, high = np.stack([west, south, 0 * top - _FOOT], 1), np.stack([east, north, top], 1)
    return ((low + high) / 2)[top > 0], ((high - low) / 2)[top > 0]


def _centre(tile: Tile, grid: np.ndarray | None) -> float:
    top = tile.tops[0, 0] if len(tile.tops) else 0.0
    ground = 0.0 if grid is None else grid[len(grid) // 2, len(grid) // 2]
    return max(0.0, float(top), float(ground))


def _ring_tables(tiles: list[Tile]) -> dict[str, np.ndarray]:
    rings = 1 + max(len(tile.edges) for tile in tiles)  # the last one is the floor outside
    edges, tops = np.full((len(tiles), rings), np.inf), np.zeros((len(tiles), rings, 4))
    for k, tile in enumerate(tiles):
        edges[k, : len(tile.edges)], tops[k, : len(tile.edges)] = tile.edges, tile.tops
    return {"edges": edges, "tops": tops}


def _grid_tables(reliefs: list[np.ndarray | None], config: TerrainConfig) -> dict[str, np.ndarray]:
    points = round(2 * HALF / config.cell) + 1
    grids, index = [np.full((points, points), -SINK)], []
    for relief in reliefs:
        index.append(0 if relief is None else len(grids))
        if relief is not None:
            grids.append(relief)
    return {"grid": np.array(index), "grids": np.stack(grids)}


def _box_tables(boxes: list[tuple[np.ndarray, np.ndarray]]) -> dict[str, np.ndarray]:
    count = max(len(pos) for pos, _ in boxes)
    positions = np.tile(np.array(PARKED), (len(boxes), count, 1))
    sizes = np.tile(np.array(_PARKED_SIZE), (len(boxes), count, 1))
    for k, (pos, size) in enumerate(boxes):
        positions[k, : len(pos)], sizes[k, : len(pos)] = pos, size
    return {"box_pos": positions, "box_size": sizes}
