"""The ground of a tile as a grid of heights: its base shape and fractal noise."""

from __future__ import annotations

import numpy as np

from kiras_rl.envs.terrains import HALF, PLATFORM, Draw, Tile, side_bounds
from kiras_rl.schema import TerrainConfig

SINK = 0.005
"""Depth of calm ground below what it follows, m: a foot then touches the floor or a box alone, and
not the height field besides."""

_WAVELENGTHS = (0.8, 0.4, 0.2)  # m: from a robot's length to a foot's
_PERSISTENCE = 0.6  # height of each octave as a part of the one before
_SHORE = 0.4  # m over which noise grows from the platform outwards


def ground_grid(tile: Tile, draw: Draw, config: TerrainConfig) -> np.ndarray | None:
    """Return heights [y, x] from -HALF to HALF, (G, G), m, or None where the floor is all.

    Args:
        tile: The shape.
        draw: Its difficulty, and its random numbers.
        config: Distance of the points and height of the noise.
    """
    if tile.ground is None and not tile.rough:
        return None
    points = round(2 * HALF / config.cell) + 1
    axis = np.linspace(-HALF, HALF, points)
    x, y = np.meshgrid(axis, axis)
    heights = _lowest_ring(tile, x, y, config.cell)
    if tile.ground is not None:
        heights = np.maximum(heights, tile.ground(x, y))
    if tile.rough:
        bumps = (draw.value(config.noise) * draw.scale + SINK) * fractal_noise(draw.rng, points)
        heights += bumps * _calm(x, y)
    return heights - SINK


def fractal_noise(rng: np.random.Generator, points: int) -> np.ndarray:
    """Return smooth random bumps of several sizes over a tile, (points, points), from 0 to 1."""
    place = np.linspace(0.0, 2 * HALF, points)
    total = np.zeros((points, points))
    for octave, wavelength in enumerate(_WAVELENGTHS):
        knots = place / wavelength
        cell = np.floor(knots).astype(int)
        part = knots - cell
        part = part * part * (3 - 2 * part)
        values = rng.random((cell[-1] + 2, cell[-1] + 2))
        rows = values[cell] + part[:, None] * (values[cell + 1] - values[cell])
        field = rows[:, cell] + part * (rows[:, cell + 1] - rows[:, cell])
        total += _PERSISTENCE**octave * field
    return (total - total.min()) / np.ptp(total)


def _calm(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return 0 on the platform and at the border of the tile, 1 between."""
    way = np.maximum(abs(x), abs(y))
    grown = np.clip((way - PLATFORM) / _SHORE, 0.0, 1.0)
    return grown * grown * (3 - 2 * grown) * (way < HALF - 1e-9)


def _lowest_ring(tile: Tile, x: np.ndarray, y: np.ndarray, cell: float) -> np.ndarray:
    """Return the lowest ring top within one cell around each point.

    Between points the ground is interpolated: with the lowest of its surroundings it never rises in
    front of a step, nor fills a gap, and edges stay sharp.
    """
    inner = np.concatenate([[0.0], tile.edges])
    outer = np.concatenate([tile.edges, [np.inf]])  # outside the last ring is the floor
    tops = np.concatenate([tile.tops, np.zeros((1, 4))])
    lowest = np.full(x.shape, np.inf)
    reach = cell - 1e-9
    for i, o, sides in zip(inner, outer, tops, strict=True):
        for (west, east, south, north), top in zip(side_bounds(i, o), sides, strict=True):
            meets = (x - reach < east) & (x + reach > west) & (y - reach < north)
            meets &= y + reach > south
            lowest = np.where(meets, np.minimum(lowest, top), lowest)
    return lowest
