"""Tiles: their shapes, their tables, and the heights of the ground against MuJoCo's rays."""

import dataclasses

import mujoco
import numpy as np
import pytest
import torch

from kiras_rl.config import ConfigError, load_config
from kiras_rl.envs import terrains
from kiras_rl.envs.ground import Ground
from kiras_rl.envs.terrain_geoms import add_terrain, terrain_geoms
from kiras_rl.envs.terrain_library import build_library
from kiras_rl.envs.terrains import Draw
from kiras_rl.phases import FINETUNING, phase_of

CONFIG = phase_of(load_config("base"), FINETUNING).config.env.terrain
LEVELS = range(CONFIG.levels)


@pytest.fixture(scope="module")
def library():
    return build_library(CONFIG)


def draw(difficulty=0.0, scale=1.0, inverted=False):
    return Draw(difficulty, scale, inverted, np.random.default_rng(0))


def every_tile(library):
    """Return a Ground with one world for each tile."""
    ground = Ground(library, library.size, torch.device("cpu"))
    ground.write(torch.ones(library.size, dtype=torch.bool), torch.arange(library.size))
    return ground


def ring_tops(library, tile, x, y):
    """Return the height of the rings of a tile, by going through them."""
    heights, inner = np.zeros_like(x), 0.0
    for outer, (east, west, north, south) in zip(
        library.edges[tile], library.tops[tile], strict=True
    ):
        inside = (np.maximum(abs(x), abs(y)) <= outer) & (np.maximum(abs(x), abs(y)) > inner)
        across = np.where(y > 0, north, south)
        top = np.where(x > inner, east, np.where(x < -inner, west, across))
        heights = np.where(inside, top, heights)
        inner = outer
    return heights


# --- shapes --------------------------------------------------------------------------------------


def test_stairs_lead_up_or_down():
    up = terrains.stairs_up(draw(1.0), riser=[0.02, 0.12], tread=0.3)
    np.testing.assert_allclose(up.edges[:3], [0.6, 0.9, 1.2])
    np.testing.assert_allclose(up.tops[:3, 0], [0.0, 0.12, 0.24])
    assert up.edges[-1] == 4.0
    down = terrains.stairs_down(draw(1.0), riser=[0.02, 0.12], tread=0.3)
    np.testing.assert_allclose(down.tops[:, 0], up.tops[::-1, 0])


def test_slopes_are_as_steep_as_asked():
    tile = terrains.slopes(draw(0.5), angle=[0.0, 30.0])
    x, y = np.array([0.5, 1.6, 0.0]), np.array([0.0, 0.0, -1.6])
    rise = 1.0 * np.tan(np.radians(15.0))
    np.testing.assert_allclose(tile.ground(x, y), [0.0, rise, rise])
    inverted = terrains.slopes(draw(0.5, inverted=True), angle=[0.0, 30.0])
    top = 3.4 * np.tan(np.radians(15.0))
    np.testing.assert_allclose(inverted.ground(x, y), [top, top - rise, top - rise])


def test_bars_are_thin_and_apart():
    tile = terrains.bars(draw(0.0), height=[0.02, 0.12], width=0.06, spacing=[0.6, 0.35])
    inner, outer = tile.edges[1::2], tile.edges[2::2]
    np.testing.assert_allclose(outer - inner, 0.06)
    np.testing.assert_allclose(np.diff(outer), 0.6)
    assert (tile.tops[::2] <= 0.02).all() and (tile.tops[2::2] >= 0.015).all()
    assert (tile.tops[1::2] == 0).all()


def test_footholds_are_plates_between_moats():
    tile = terrains.footholds(
        draw(1.0), plate=[0.35, 0.2], gap=[0.04, 0.12], depth=[0.1, 0.15], unevenness=[0.0, 0.02]
    )
    np.testing.assert_allclose(tile.edges[1::2] - tile.edges[0:-1:2], 0.12)  # moats
    np.testing.assert_allclose(tile.edges[2::2] - tile.edges[1::2], 0.2)  # plates
    assert tile.tops[0, 0] == 0.15
    assert (abs(tile.tops[2::2] - 0.15) <= 0.01).all() and np.ptp(tile.tops[2::2]) > 0
    assert (tile.tops[1::2] == 0).all()


def test_pits_are_wide_trenches_in_a_plateau():
    tile = terrains.pits(draw(1.0), depth=[0.01, 0.12], width=0.5, spacing=1.1)
    np.testing.assert_allclose(tile.edges[:3], [0.6, 1.1, 1.7])  # platform, trench, plateau
    np.testing.assert_allclose(tile.tops[:3, 0], [0.12, 0.0, 0.12])


def test_plates_lie_side_by_side_in_no_order():
    tile = terrains.plates(draw(1.0), height=[0.02, 0.2], width=0.4)
    np.testing.assert_allclose(np.diff(tile.edges), 0.4)
    assert (tile.tops[0] == 0.1).all()
    assert (tile.tops >= 0).all() and (tile.tops <= 0.2).all() and np.ptp(tile.tops[1:]) > 0.1


def test_ramps_go_up_and_down_in_turn():
    tile = terrains.ramps(draw(1.0), angle=[0.0, 45.0], length=0.5)
    x = np.array([0.6, 0.85, 1.1, 1.6, 2.1])
    np.testing.assert_allclose(tile.ground(x, 0 * x), [0.0, 0.25, 0.5, 0.0, 0.5], atol=1e-9)


def test_rough_ground_differs_from_point_to_point_and_spares_the_platform():
    tile = terrains.rough(draw(1.0), height=[0.01, 0.08])
    axis = np.linspace(-4.0, 4.0, 81)
    x, y = np.meshgrid(axis, axis)
    height = tile.ground(x, y)
    platform = np.maximum(abs(x), abs(y)) <= 0.61
    assert (height[platform] == 0).all()
    outside = np.maximum(abs(x), abs(y)) > 0.75
    assert height[outside].mean() == pytest.approx(0.04, abs=0.002)
    assert height[outside].max() <= 0.08


def test_a_larger_robot_meets_larger_obstacles():
    small = terrains.stairs_up(draw(0.0, scale=1.0), riser=0.1, tread=0.3)
    large = terrains.stairs_up(draw(0.0, scale=1.5), riser=0.1, tread=0.3)
    np.testing.assert_allclose(large.edges[:2], [0.6, 1.05])  # the platform stays
    np.testing.assert_allclose(large.tops[1], 1.5 * small.tops[1])


# --- library -------------------------------------------------------------------------------------


def test_every_combination_has_its_number(library):
    kinds, levels, variants = np.meshgrid(
        range(len(library.types)), range(library.levels), range(library.variants), indexing="ij"
    )
    numbers = library.index(kinds, levels, variants)
    np.testing.assert_array_equal(np.sort(numbers.ravel()), np.arange(library.size))
    assert library.proportions.sum() == pytest.approx(1.0)


def test_a_library_repeats_from_its_seed(library):
    again = build_library(CONFIG)
    other = build_library(dataclasses.replace(CONFIG, seed=CONFIG.seed + 1))
    for name in ("edges", "tops", "grids", "box_pos", "box_size"):
        np.testing.assert_array_equal(getattr(again, name), getattr(library, name))
    assert (other.grids != library.grids).any()


def test_a_tile_does_not_depend_on_the_other_types(library):
    alone = build_library(dataclasses.replace(CONFIG, types={"bars": CONFIG.types["bars"]}))
    assert alone.proportions.tolist() == [1.0]
    first = library.index(library.types.index("bars"), 0, 0)
    rings = alone.edges.shape[1]
    np.testing.assert_array_equal(alone.edges, library.edges[first : first + 40, :rings])
    np.testing.assert_array_equal(alone.tops, library.tops[first : first + 40, :rings])
    np.testing.assert_array_equal(alone.grids[1:], library.grids[library.grid[first:][:40]])


def test_the_platform_is_level_and_robots_start_on_it(library):
    ground = every_tile(library)
    points = torch.rand(1, 300, 2).expand(library.size, -1, -1) * 1.0 - 0.5
    heights = ground.heights(points)
    torch.testing.assert_close(heights, ground.spawn_height[:, None].expand_as(heights))


def test_bumps_stick_out_of_rings_and_never_soften_an_edge(library):
    ground = every_tile(library)
    points = torch.rand(1, 4000, 2) * 7.9 - 3.95
    heights = ground.heights(points.expand(library.size, -1, -1)).numpy()
    x, y = points[0].double().numpy().T
    for tile in range(library.size):
        kind, level = divmod(tile // library.variants, library.levels)
        if library.types[kind] in ("slopes", "ramps", "rough"):
            continue
        bump = heights[tile] - ring_tops(library, tile, x, y)
        highest = 0.0 if library.types[kind] == "flat" else 0.04 * level / 9
        assert bump.min() > -1e-6
        assert bump.max() < highest + 1e-6
        if library.types[kind] in ("bars", "stairs_up", "stairs_down", "pits", "plates"):
            assert bump.max() >= 0.7 * highest


# --- heights -------------------------------------------------------------------------------------


class Rays:
    """MuJoCo's view of one tile after the other."""

    def __init__(self, library):
        spec = mujoco.MjSpec()
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0, 0, 0.05))
        add_terrain(spec, library)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.terrain = terrain_geoms(self.model, library)

    def show(self, tile):
        self.terrain.show(self.model, self.data, tile)
        mujoco.mj_forward(self.model, self.data)

    def heights(self, points):
        down, hit = np.array([0.0, 0.0, -1.0]), np.zeros(1, dtype=np.int32)
        return [
            10.0
            - mujoco.mj_ray(
                self.model, self.data, np.array([x, y, 10.0]), down, None, 1, -1, hit, None
            )
            for x, y in points
        ]


@pytest.fixture(scope="module")
def rays(library):
    return Rays(library)


def away_from_edges(library, tile, points):
    """Keep the points that no vertical face is near: between rings, sides, and at the border."""
    x, y = abs(points).T
    edges = library.edges[tile][np.isfinite(library.edges[tile])]
    near = np.zeros(len(points), dtype=bool)
    for edge in (*edges, 4.0):
        near |= (abs(x - edge) < 1e-4) | (abs(y - edge) < 1e-4)
    return points[~near]


@pytest.mark.parametrize("kind", CONFIG.types)
def test_heights_are_those_that_rays_see(library, rays, kind):
    ground = Ground(library, 1, torch.device("cpu"))
    rng = np.random.default_rng(3)
    for level in LEVELS:
        for variant in range(2):
            tile = library.index(library.types.index(kind), level, variant)
            rays.show(tile)
            ground.tile[:] = tile
            points = rng.uniform(-4.2, 4.2, (150, 2)).astype(np.float32)
            points = away_from_edges(library, tile, points)
            heights = ground.heights(torch.tensor(points)[None])[0]
            np.testing.assert_allclose(heights, rays.heights(points), rtol=0, atol=1e-4)


def test_worlds_have_their_own_tiles(library):
    ground = Ground(library, 3, torch.device("cpu"))
    stairs = library.index(library.types.index("stairs_down"), 9, 1)
    ground.write(torch.tensor([False, True, False]), torch.full((3,), stairs))
    assert ground.tile.tolist() == [0, stairs, 0]
    centre = ground.heights(torch.zeros(3, 1, 2))[:, 0]
    torch.testing.assert_close(centre, torch.tensor([0.0, 11 * 0.12, 0.0]))
    torch.testing.assert_close(centre, ground.spawn_height)


def test_a_position_that_is_not_a_number_is_harmless(library):
    ground = every_tile(library)
    points = torch.full((library.size, 2, 2), torch.nan)
    points[:, 1] = torch.inf
    assert (ground.heights(points) == 0).all()


# --- what cannot be ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("stairs_upp", {"proportion": 1.0}, "no term 'stairs_upp': did you mean 'stairs_up'?"),
        ("flat", {}, "types.flat: no proportion; it takes proportion"),
        ("flat", 0.1, "types.flat: give a proportion, as in flat: {proportion: 0.2}"),
        ("flat", {"proportion": 0.1, "up": 1}, "unknown parameter 'up'; it takes proportion"),
        ("flat", {"proportion": -1}, "env.terrain.types: the proportions have to be positive"),
        ("slopes", {"proportion": 1}, "types.slopes: no 'angle'; it takes angle"),
        ("slopes", {"angle": "steep"}, "give one number or [lowest level, top level], not 'steep'"),
        ("slopes", {"angle": [1, 2, 3]}, "give one number or [lowest level, top level], not [1,"),
        ("slopes", {"angle": -5}, "slopes: an angle of -5 degrees; allowed are 0 to 60"),
        (
            "stairs_up",
            {"tread": 0, "riser": 0.1},
            "stairs_up: 0 m is not a length: it has to be posi",
        ),
        (
            "stairs_up",
            {"tread": 0.1, "riser": 0.1},
            "stairs_up: 136 boxes a tile, 48 are allowed: put",
        ),
        ("bars", {"height": 0.1, "width": 0.7, "spacing": 0.5}, "bars: its rings overlap"),
    ],
)
def test_a_type_that_cannot_be_is_one_clear_line(name, values, message):
    if isinstance(values, dict) and len(values) and "proportion" not in values:
        values = {"proportion": 1.0, **values}
    assert message in refusal(dataclasses.replace(CONFIG, types={name: values}))


def test_cells_have_to_fill_the_tile():
    message = refusal(dataclasses.replace(CONFIG, cell=0.3))
    assert "env.terrain.cell=0.3: a tile of 8 m has to be a whole number of cells" in message


def test_there_has_to_be_a_type():
    assert "one at least" in refusal(dataclasses.replace(CONFIG, types={"flat": None}))


def refusal(config):
    """Return the message with which a library is refused: always one line."""
    with pytest.raises(ConfigError) as caught:
        build_library(config)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("key", ["levels", "variants", "scale", "cell"])
def test_sizes_are_positive(key):
    config = load_config("base", [f"finetuning.env.terrain.{key}=0"])
    with pytest.raises(ConfigError, match=f"env.terrain.{key}=0.*: must be positive"):
        phase_of(config, FINETUNING)
