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
        self._inner = torch.nn.functional.pad(self._edges[:, :-1], (1, 0))
        self._points, self._cell = library.grids.shape[1], library.cell
        self._first = table(library.grid, torch.int64) * self._points**2
        self._strides = table([1, self._points], torch.int64)
        self._heights = table(library.grids).flatten()
        self._spawn = table(library.spawn_height)
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
        points = points.nan_to_num(nan=2 * HALF)
        way = points.abs()  # from the middle, along x and y
        height = torch.maximum(self._ring_tops(points, way), self._ground(points))
        return height.masked_fill(way.amax(-1) > HALF, 0.0).clamp(min=0.0)

    def _ring_tops(self, points: torch.Tensor, way: torch.Tensor) -> torch.Tensor:
        ring = torch.searchsorted(self._edges[self.tile], way.amax(-1))  # the last is infinite
        inner = self._inner[self.tile].gather(1, ring)
        is_west, is_south = (points <= 0).unbind(-1)
        side = torch.where(way[..., 0] > inner, is_west, 2 + is_south)
        return self._tops[self.tile].gather(1, 4 * ring + side)

    def _ground(self, points: torch.Tensor) -> torch.Tensor:
        """Interpolate on the triangles of MuJoCo: the cut goes from south-west to north-east."""
        last = self._points - 1
        uv = ((points + HALF) / self._cell).clamp(0.0, last)
        cell = uv.floor().clamp(max=last - 1)
        u, v = (uv - cell).unbind(-1)
        corner = (cell.long() * self._strides).sum(-1) + self._first[self.tile, None]
        south_west, north_east = self._heights[corner], self._heights[corner + self._points + 1]
        # The third corner is the one in the east where u > v, else the one in the north.
        other = self._heights[torch.where(u > v, corner + 1, corner + self._points)]
        far, near = torch.maximum(u, v), torch.minimum(u, v)
        return south_west + far * (other - south_west) + near * (north_east - other)
