"""The ground that one robot is driven on: what there is to choose from, and how high it lies."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property

import mujoco
import numpy as np

from kiras_rl.config import ConfigError, config_from_dict, list_configs, load_config
from kiras_rl.deploy.policy import PolicyMetadata
from kiras_rl.envs.terrain_geoms import add_tile
from kiras_rl.envs.terrain_library import TerrainLibrary, build_library
from kiras_rl.phases import plan
from kiras_rl.schema import Config, TerrainConfig

_ABOVE = 50.0  # m: higher than any tile
_SPACING = 0.1  # m, of the points under the base, as in training
_POINTS = _SPACING * np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2)
_DOWN = np.array([0.0, 0.0, -1.0])

GROUND_GROUP = np.array([1, 0, 0, 0, 0, 0], np.uint8)
"""What a ray may hit: group 0, floor and terrain."""


@dataclass(frozen=True)
class Tile:
    """Which ground: its type, its level of difficulty, its variant."""

    kind: str = "flat"
    level: int = 0
    variant: int = 0

    @property
    def is_flat(self) -> bool:
        """Whether it is the endless floor alone, which has neither levels nor variants."""
        return self.kind == "flat"

    def __str__(self) -> str:
        """Write it as `--terrain` takes it."""
        return "flat" if self.is_flat else f"{self.kind}:{self.level}:{self.variant}"


FLAT = Tile()
"""What there always is."""


class Terrain:
    """The tiles that a robot can be put on. They are made when the first one is shown.

    Attributes:
        config: What they are made from.
        kinds: Names of the types; flat ground comes first and is always there.
    """

    def __init__(self, config: TerrainConfig) -> None:
        """Take a configuration."""
        types = {kind: values for kind, values in config.types.items() if values is not None}
        self.config = replace(config, types=types)
        self.kinds = (FLAT.kind, *(kind for kind in types if kind != FLAT.kind))

    @property
    def levels(self) -> int:
        """How many there are, from 0."""
        return self.config.levels

    @property
    def variants(self) -> int:
        """How many there are of each type and level, from 0."""
        return self.config.variants

    def check(self, tile: Tile) -> None:
        """Check that there is such a tile.

        Raises:
            ConfigError: If there is none.
        """
        if tile.kind not in self.kinds:
            raise ConfigError(f"no terrain '{tile.kind}'; there are: {', '.join(self.kinds)}")
        for name, number, count in (
            ("level", tile.level, self.levels),
            ("variant", tile.variant, self.variants),
        ):
            if not 0 <= number < count:
                raise ConfigError(f"no terrain {name} {number}; it goes from 0 to {count - 1}")

    def parse(self, text: str) -> Tile:
        """Read `TYPE[:LEVEL[:VARIANT]]`; what is left out is 0.

        Raises:
            ConfigError: If it cannot be read, or there is no such tile.
        """
        kind, *numbers = text.split(":")
        if len(numbers) > 2 or not all(number.isdecimal() for number in numbers):
            raise ConfigError(
                f"a terrain is TYPE[:LEVEL[:VARIANT]], e.g. {self.kinds[-1]}:4, not '{text}'; "
                f"types: {', '.join(self.kinds)}; levels 0 to {self.levels - 1}, "
                f"variants 0 to {self.variants - 1}"
            )
        tile = Tile(kind, *map(int, numbers))
        self.check(tile)
        return tile

    def nearest(self, tile: Tile) -> Tile:
        """Return what comes nearest to a tile of another terrain."""
        kind = tile.kind if tile.kind in self.kinds else FLAT.kind
        return Tile(kind, min(tile.level, self.levels - 1), min(tile.variant, self.variants - 1))

    def build(self, spec: mujoco.MjSpec, tile: Tile) -> None:
        """Add a tile to a scene.

        Raises:
            ConfigError: If there is no such tile, or the configuration holds what cannot be.
        """
        self.check(tile)
        if not tile.is_flat:
            number = self._library.types.index(tile.kind)
            add_tile(spec, self._library, self._library.index(number, tile.level, tile.variant))

    @cached_property
    def _library(self) -> TerrainLibrary:
        return build_library(self.config)


def terrain_of(metadata: PolicyMetadata) -> Terrain:
    """Return the terrain of a policy's run, else of its robot's configuration, else of base.

    A run without finetuning has none, and one that this version cannot read counts as such.
    """
    return Terrain(_own_terrain(metadata.provenance.get("config")) or _default(metadata.robot))


def ground_height(model: mujoco.MjModel, data: mujoco.MjData, place: np.ndarray) -> float:
    """Return the mean height of the ground at 3 x 3 points around a place, (2,), m.

    This is the ground under the base of a robot that stands there, as training takes it.
    """
    geom = np.zeros(1, np.int32)
    down = [
        mujoco.mj_ray(model, data, (*point, _ABOVE), _DOWN, GROUND_GROUP, 1, -1, geom)
        for point in place + _POINTS
    ]
    return _ABOVE - sum(down) / len(down)


def _own_terrain(saved: object) -> TerrainConfig | None:
    if not isinstance(saved, Mapping) or not saved.get("finetuning"):
        return None
    return _read(json.dumps(saved))


@cache  # it takes half a second, and every checkpoint of a run that is followed asks for it
def _read(saved: str) -> TerrainConfig | None:
    try:
        terrain = _terrain(config_from_dict(json.loads(saved)))
        if terrain:  # its types may have other names by now: make the fewest tiles
            build_library(replace(terrain, levels=2, variants=1))
        return terrain
    except ConfigError:
        return None


@cache
def _default(robot: str) -> TerrainConfig:
    shipped = _terrain(load_config(robot)) if robot in list_configs() else None
    terrain = shipped or _terrain(load_config("base"))
    assert terrain is not None
    return terrain


def _terrain(config: Config) -> TerrainConfig | None:
    return plan(config)[-1].config.env.terrain
