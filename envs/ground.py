"""How high the ground is: the tile of each world as tables, exact and without rays."""

from __future__ import annotations

import torch

from kiras_rl.envs.terrain_library import TerrainLibrary
from kiras_rl.envs.terrains import HALF


class Ground:
    """The tiles that N worlds show, for looking heights up.

    Attributes:
        tile: The tile of each world, (N,) int64; all start on tile 0.
    """

    def __init__(self, library: TerrainLibrary, num_worlds: int, device: torch.device) -> None:
        """Copy the tables to the device."""

        def table(values: object, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.tensor(values, dtype=dtype, device=device)

        self._edges, self._tops = table(library.edges), table(library.tops).flatten(1)
        self._grid = table(library.grid, torch.int64)
        self._heights = table(library.grids).flatten()
        self._spawn = table(library.spawn_height)
        self._points, self._cell = library.grids.shape[1], library.cell
        self.tile = torch.zeros(num_worlds, dtype=torch.int64, device=device)

    def write(self, mask: torch.Tensor, tile: torch.Tensor) -> None:
        """Give the masked worlds, (N,) bool, new tiles, (N,) int64."""
        self.tile.copy_(torch.where(mask, tile, self.tile))

    @property
    def spawn_height(self) -> torch.Tensor:
        """Height of the platform in the centre, (N,), m."""
        return self._spawn[self.tile]

    def heights(self, points: torch.Tensor) -> torch.Tensor:
        """Return the height of the ground at horizontal positions.

        Args:
            points: Positions in the world, (N, P, 2), m. What is not a number is off the tile.

        Returns:
            Heights, (N, P), m.
        """
        x, y = points.nan_to_num(nan=2 * HALF).movedim(-1, 0).contiguous().unbind()
        way = torch.maximum(x.abs(), y.abs())
        height = torch.maximum(self._ring_tops(x, y, way), self._ground(x, y))
        return torch.where(way <= HALF, height, 0.0).clamp(min=0.0)

    def _ring_tops(self, x: torch.Tensor, y: torch.Tensor, way: torch.Tensor) -> torch.Tensor:
        edges = self._edges[self.tile]
        ring = torch.searchsorted(edges, way)  # the last edge is infinite
        inner = edges.gather(1, (ring - 1).clamp(min=0)) * (ring > 0)
        across = torch.where(y > 0, 2, 3)
        side = torch.where(x > inner, 0, torch.where(x < -inner, 1, across))
        return self._tops[self.tile].gather(1, 4 * ring + side)

    def _ground(self, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        """Interpolate on the triangles of MuJoCo: the cut goes from south-west to north-east."""
        last = self._points - 1
        u = ((x + HALF) / self._cell).clamp(0.0, last)
        v = ((y + HALF) / self._cell).clamp(0.0, last)
        column, row = u.floor().clamp(max=last - 1), v.floor().clamp(max=last - 1)
        u, v = u - column, v - row
        corner = self._grid[self.tile, None] * self._points**2
        corner = corner + row.long() * self._points + column.long()
        south_west, north_east = self._heights[corner], self._heights[corner + self._points + 1]
        is_south = u > v
        other = self._heights[corner + torch.where(is_south, 1, self._points)]
        far, near = torch.where(is_south, u, v), torch.where(is_south, v, u)
        return south_west + far * (other - south_west) + near * (north_east - other)
