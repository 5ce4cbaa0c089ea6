"""Terrain types: one pure function each, (Draw, parameters of the YAML) -> Tile.

A tile is a square around the origin of a world, made of square rings around the centre, where the
robot starts: whichever way it goes, it crosses the obstacles. Nothing lies lower than the floor at
z = 0; what leads down starts high.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

HALF = 4.0
"""Half the width of a tile, m."""

CROSSED = HALF - 0.3
"""A robot this far from the middle, the larger of |x| and |y|, has crossed its tile, m."""

PLATFORM = 0.6
"""Half the width of the level ground in the centre, m; it does not scale with the robot."""

SIDES = ("E", "W", "N", "S")
"""Order of the four sides of a ring: +x and -x over the whole width, +y and -y between them."""

Range = float | list[float] | tuple[float, float]
"""One value, or [at the lowest level, at the top level]."""

Surface = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Heights of a ground, (x, y) -> z, arrays of one shape, m."""


@dataclass(frozen=True)
class Tile:
    """The shape of one tile.

    Attributes:
        edges: Outer half widths of R rings without gaps, ascending, (R,), m. Ring 0 is the
            platform in the centre; outside the last ring is the floor.
        tops: Height of each side of each ring, (R, 4), m; 0 is the floor. See SIDES.
        ground: Ground between and under the rings, None for the floor.
        rough: Whether the ground carries noise.
    """

    edges: np.ndarray
    tops: np.ndarray
    ground: Surface | None = None
    rough: bool = True

    def __post_init__(self) -> None:
        """Check the rings.

        Raises:
            ValueError: Rings that overlap, leave the tile or lie below the floor.
        """
        if (np.diff(self.edges, prepend=0.0) <= 0).any():
            raise ValueError("its rings overlap: every length has to be positive and fit")
        if (self.edges > HALF + 1e-9).any():
            raise ValueError(f"its rings leave the tile, which is {2 * HALF:g} m wide")
        if (self.tops < 0).any():
            raise ValueError("it goes below the floor: heights have to be positive")


@dataclass(frozen=True)
class Draw:
    """What tells one tile of a type from another.

    Attributes:
        difficulty: 0 at the lowest level, 1 at the top level.
        scale: Factor of all lengths of obstacles, for the size of the robot.
        inverted: True in every second variant, for a type that leads either up or down.
        rng: Random numbers of this tile alone.
    """

    difficulty: float
    scale: float
    inverted: bool
    rng: np.random.Generator

    def value(self, limits: Range) -> float:
        """Interpolate between the value of the lowest and that of the top level.

        Raises:
            ValueError: Neither a number nor two.
        """
        ends = limits if isinstance(limits, list | tuple) else (limits, limits)
        numbers = all(isinstance(x, int | float) and not isinstance(x, bool) for x in ends)
        if len(ends) != 2 or not numbers:
            raise ValueError(f"give one number or [lowest level, top level], not {limits!r}")
        return float(ends[0] + (ends[1] - ends[0]) * self.difficulty)

    def length(self, limits: Range) -> float:
        """Return `value` times the scale, m.

        Raises:
            ValueError: As `value`, or not positive.
        """
        length = self.scale * self.value(limits)
        if length <= 0:
            raise ValueError(f"{limits!r} m is not a length: it has to be positive")
        return length


def flat(draw: Draw) -> Tile:
    """Return the floor alone."""
    return Tile(np.zeros(0), np.zeros((0, 4)), rough=False)


def slopes(draw: Draw, angle: Range) -> Tile:
    """Return a pyramid around the platform, which is its top where inverted, else its bottom.

    Args:
        draw: Which tile.
        angle: Inclination, 0 to 60 degrees.

    Raises:
        ValueError: Another inclination.
    """
    steepness = _steepness(draw, angle)

    def ground(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        way = np.maximum(np.maximum(abs(x), abs(y)), PLATFORM)
        return steepness * (HALF - way if draw.inverted else way - PLATFORM)

    return Tile(np.zeros(0), np.zeros((0, 4)), ground)


def bars(draw: Draw, height: Range, width: Range, spacing: Range) -> Tile:
    """Return thin raised rings on the ground; the sides of a ring differ by a quarter at most.

    Args:
        draw: Which tile.
        height: Of the highest side, m.
        width: In the direction of walking, m.
        spacing: From one bar to the next, m.
    """
    thick, step = draw.length(width), draw.length(spacing)
    inner = np.arange(PLATFORM + step - thick, HALF - thick, step)
    tops = draw.length(height) * draw.rng.uniform(0.75, 1.0, (len(inner), 4))
    return _separate(inner, inner + thick, tops)


def footholds(draw: Draw, plate: Range, gap: Range, depth: Range, unevenness: Range) -> Tile:
    """Return plates with moats between them.

    Args:
        draw: Which tile.
        plate: Width of a plate, m.
        gap: Width of a moat, m.
        depth: Mean height of the plates over the floor, m.
        unevenness: Largest difference between the heights of two plates, m.
    """
    moat, step = draw.length(gap), draw.length(gap) + draw.length(plate)
    inner = np.arange(PLATFORM + moat, HALF - draw.length(plate), step)
    uneven = draw.scale * draw.value(unevenness) * draw.rng.uniform(-0.5, 0.5, (len(inner), 4))
    top = draw.length(depth)
    return _separate(inner, inner + draw.length(plate), top + uneven, centre=top)


def stairs_up(draw: Draw, riser: Range, tread: Range) -> Tile:
    """Return steps up from the platform.

    Args:
        draw: Which tile.
        riser: Height of a step, m.
        tread: Depth of a step, m; the outermost takes what is left of the tile.
    """
    edges, tops = _steps(draw, riser, tread)
    return Tile(edges, tops)


def stairs_down(draw: Draw, riser: Range, tread: Range) -> Tile:
    """Return steps down from the platform; parameters as `stairs_up`."""
    edges, tops = _steps(draw, riser, tread)
    return Tile(edges, tops[::-1].copy())


def pits(draw: Draw, depth: Range, width: Range, spacing: Range) -> Tile:
    """Return trenches to step down into and up out of, wide enough to stand in.

    Args:
        draw: Which tile.
        depth: Of a trench, m.
        width: Of a trench, m.
        spacing: From one trench to the next, m.
    """
    trench, step = draw.length(width), draw.length(spacing)
    inner = np.arange(PLATFORM + trench, HALF - (step - trench), step)
    top = draw.length(depth)
    return _separate(inner, inner + (step - trench), np.full((len(inner), 4), top), centre=top)


def plates(draw: Draw, height: Range, width: Range) -> Tile:
    """Return plates side by side, each of another height: steps up and down in no order.

    Args:
        draw: Which tile.
        height: Of the highest, m; the platform has half of it.
        width: Of a plate in the direction of walking, m.
    """
    edges = np.arange(PLATFORM, HALF + 1e-9, draw.length(width))
    top = draw.length(height)
    tops = top * draw.rng.uniform(0.0, 1.0, (len(edges), 4))
    tops[0] = top / 2
    return Tile(edges, tops)


def ramps(draw: Draw, angle: Range, length: Range) -> Tile:
    """Return ridges: slabs that are tilted up and down in turn.

    Args:
        draw: Which tile.
        angle: Inclination, 0 to 60 degrees.
        length: Of a slab along the ground, m.

    Raises:
        ValueError: Another inclination.
    """
    steepness, slab = _steepness(draw, angle), draw.length(length)

    def ground(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        way = np.maximum(np.maximum(abs(x), abs(y)) - PLATFORM, 0.0)
        return steepness * (slab - abs(way % (2 * slab) - slab))

    return Tile(np.zeros(0), np.zeros((0, 4)), ground)


def rough(draw: Draw, height: Range) -> Tile:
    """Return ground that is uneven at the size of a foot.

    Args:
        draw: Which tile.
        height: Between the lowest and the highest points, m; neighbours are a cell apart.
    """
    top = draw.length(height)

    def ground(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        outside = np.maximum(abs(x), abs(y)) > PLATFORM + 0.1  # the platform's edge is level, too
        return top * draw.rng.uniform(size=x.shape) * outside

    return Tile(np.zeros(0), np.zeros((0, 4)), ground, rough=False)


def side_bounds(inner: float, outer: float) -> tuple[tuple[float, float, float, float], ...]:
    """Return west, east, south and north end of the four SIDES of a ring, m."""
    return (
        (inner, outer, -outer, outer),
        (-outer, -inner, -outer, outer),
        (-inner, inner, inner, outer),
        (-inner, inner, -outer, -inner),
    )


def _steepness(draw: Draw, angle: Range) -> float:
    """Return the rise per length of an inclination in degrees."""
    degrees = draw.value(angle)
    if not 0.0 <= degrees <= 60.0:
        raise ValueError(f"an angle of {degrees:g} degrees; allowed are 0 to 60")
    return np.tan(np.radians(degrees))


def _steps(draw: Draw, riser: Range, tread: Range) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges and ascending tops of a flight that fills the tile."""
    count = int((HALF - PLATFORM) / draw.length(tread))
    edges = PLATFORM + draw.length(tread) * np.arange(count + 1)
    edges[-1] = HALF
    heights = draw.length(riser) * np.arange(count + 1)
    return edges, np.tile(heights[:, None], (1, 4))


def _separate(inner: np.ndarray, outer: np.ndarray, tops: np.ndarray, centre: float = 0.0) -> Tile:
    """Return rings with the floor between them, and a platform of height `centre`."""
    gaps = np.zeros_like(tops)
    edges = np.concatenate([[PLATFORM], np.stack([inner, outer], axis=1).ravel()])
    sides = np.concatenate([np.full((1, 4), centre), np.stack([gaps, tops], axis=1).reshape(-1, 4)])
    return Tile(edges, sides)
