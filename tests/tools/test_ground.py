"""The ground under one robot: its names, where it comes from, how high it is, driving on it."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest
import torch

from kiras_rl.config import ConfigError, config_to_dict, load_config
from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.envs.ground import Ground
from kiras_rl.envs.terrain_library import build_library
from kiras_rl.robots.robot import load_robot
from kiras_rl.tools.driving.driver import Driver
from kiras_rl.tools.driving.ground import FLAT, Terrain, Tile, ground_height, terrain_of
from kiras_rl.tools.driving.script import Segment, record
from kiras_rl.tools.driving.summary import summarize
from kiras_rl.tools.shared.policy_files import load_policy

KINDS = (
    "flat", "slopes", "bars", "footholds", "stairs_up", "stairs_down",
    "pits", "plates", "ramps", "rough",
)  # fmt: skip
RISER = 0.12  # m, at the top level
UP, DOWN = 0, 1  # variants


@pytest.fixture(scope="module")
def policy():
    """Load the shipped policy, which can stand."""
    return load_policy(None)


def drive(policy_file, terrain, *tile):
    driver = Driver(OnboardPolicy(policy_file), terrain)
    driver.show(*tile)
    return driver


# --- names and configurations --------------------------------------------------------------------


def test_a_tile_is_read(terrain):
    assert terrain.kinds == KINDS
    assert terrain.parse("stairs_up:4:1") == Tile("stairs_up", 4, 1)
    assert terrain.parse("slopes:9") == Tile("slopes", 9, 0)
    assert terrain.parse("bars") == Tile("bars", 0, 0)
    assert terrain.parse("flat").is_flat
    assert str(Tile("stairs_up", 4, 1)) == "stairs_up:4:1"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stair", "no terrain 'stair'; there are: flat, slopes, bars, footholds, stairs_up"),
        ("stairs_up:10", "no terrain level 10; it goes from 0 to 9"),
        ("stairs_up:0:4", "no terrain variant 4; it goes from 0 to 3"),
        (
            "stairs_up:-1",
            "not 'stairs_up:-1'; types: flat, slopes, .*; levels 0 to 9, variants 0 to 3",
        ),
        (
            "stairs_up:high",
            r"a terrain is TYPE\[:LEVEL\[:VARIANT\]\], e.g. rough:4, not 'stairs_up:high'",
        ),
        ("stairs_up:1:1:1", "not 'stairs_up:1:1:1'"),
    ],
)
def test_a_tile_that_cannot_be_is_named_with_those_that_can(terrain, text, message):
    with pytest.raises(ConfigError, match=message):
        terrain.parse(text)


def test_the_terrain_is_that_of_the_policys_run(make_metadata):
    config = load_config("base", ["finetuning.env.terrain.levels=3"])
    metadata = make_metadata(provenance={"config": config_to_dict(config)})
    assert terrain_of(metadata).levels == 3


def test_a_run_without_finetuning_gets_the_terrain_of_its_robots_configuration(make_metadata):
    config = config_to_dict(load_config("base", ["finetuning=null"]))
    flat = make_metadata(provenance={"config": config})
    assert terrain_of(flat).config.scale == 1.0
    assert terrain_of(dataclasses.replace(flat, robot="go1")).config.scale == 1.5
    assert terrain_of(dataclasses.replace(flat, robot="another")).config.scale == 1.0


def test_a_run_that_cannot_be_read_still_drives(make_metadata):
    broken = {"config": {"finetuning": {"iterations": 1}, "no_such_key": 1}}
    assert terrain_of(make_metadata(provenance=broken)).kinds == KINDS


def test_a_run_with_types_of_an_earlier_version_drives_on_those_of_today(make_metadata):
    config = config_to_dict(load_config("base"))
    types = config["finetuning"]["env"]["terrain"]["types"]
    types["stairs"] = types.pop("stairs_up")
    assert terrain_of(make_metadata(provenance={"config": config})).kinds == KINDS


def test_flat_ground_is_there_even_if_a_run_had_none(terrain):
    types = terrain.config.types | {"flat": None, "bars": None}
    other = Terrain(dataclasses.replace(terrain.config, types=types))
    assert other.kinds == tuple(kind for kind in KINDS if kind != "bars")


def test_of_another_terrain_the_nearest_tile_is_taken(terrain):
    small = Terrain(dataclasses.replace(terrain.config, levels=3, variants=1))
    assert small.nearest(Tile("stairs_up", 7, 2)) == Tile("stairs_up", 2, 0)
    assert small.nearest(Tile("ice", 1, 0)).is_flat


# --- heights -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS[1:])
@pytest.mark.parametrize("variant", [UP, DOWN])
def test_heights_are_those_of_training(still_file, terrain, kind, variant):
    """Places in the open and on the corners of the height field's cells, off the tile as well."""
    driver = drive(still_file, terrain, kind, 9, variant)
    library = build_library(terrain.config)
    ground = Ground(library, 1, torch.device("cpu"))
    tile = library.index(library.types.index(kind), 9, variant)
    ground.write(torch.ones(1, dtype=torch.bool), torch.tensor([tile]))
    random = np.random.default_rng(0).uniform(-4.5, 4.5, (40, 2))
    grid = np.stack(np.meshgrid([-2.0, 0.0, 1.3], [-2.0, 0.0, 1.3]), -1).reshape(-1, 2) + 1e-4
    offsets = 0.1 * np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), -1).reshape(-1, 2)
    for place in np.concatenate([random, grid]):
        points = torch.tensor(place + offsets, dtype=torch.float32)[None]
        expected = float(ground.heights(points).mean())
        assert ground_height(driver.model, driver.data, place) == pytest.approx(expected, abs=1e-4)


def test_the_base_is_measured_from_the_ground_under_it(still_file, smooth_terrain):
    """1.5 to 1.8 m from the middle is the fourth step."""
    driver = drive(still_file, smooth_terrain, "stairs_up", 9)
    driver.data.qpos[:3] = (1.65, 0.0, 4 * RISER + 1.0)
    assert driver.step().base_height == pytest.approx(1.0, abs=0.01)
    assert driver.data.qpos[2] == pytest.approx(4 * RISER + 1.0, abs=0.01)


def test_at_an_edge_it_is_measured_from_the_mean_of_nine_points(still_file, smooth_terrain):
    """Three of nine points at 1.72 + 0.1 m are on the fifth step."""
    driver = drive(still_file, smooth_terrain, "stairs_up", 9)
    driver.data.qpos[:3] = (1.72, 0.0, 2.0)
    assert driver.ground_height((1.72, 0.0)) == pytest.approx((4 + 1 / 3) * RISER)


# --- driving -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("variant", [UP, DOWN])
@pytest.mark.parametrize("skill", ["walk", "stilt"])
def test_it_stands_on_every_platform_in_its_keyframe(policy, terrain, kind, variant, skill):
    driver = Driver(policy, terrain)
    driver.set_task(skill, (0, 0, 0))
    driver.show(kind, 9, variant)
    samples = [driver.step() for _ in range(75)]
    assert not any(sample.fallen or sample.crossed for sample in samples)
    assert samples[-1].base_height == pytest.approx(driver.posture.base_height, abs=0.03)


def test_on_a_tile_the_feet_begin_just_above_the_platform(still_file, smooth_terrain):
    """Down from the middle: eleven steps of 0.3 m between 0.6 and 4 m."""
    driver = drive(still_file, smooth_terrain, "stairs_down", 9)
    feet = [driver.data.geom(name).xpos[2] for name in driver.robot.foot_geoms]
    assert min(feet) == pytest.approx(11 * RISER + 0.016 + 0.002, abs=1e-6)


def test_the_end_of_a_tile_is_crossed_and_not_a_fall(still_file, terrain):
    driver = drive(still_file, terrain, "stairs_down", 0)
    for place, crossed in (((3.69, 0), False), ((3.71, 0), True), ((0, -3.71), True)):
        driver.data.qpos[:2] = place
        driver.data.qpos[2] = 1.0
        driver.data.qvel[:] = 0
        sample = driver.step()
        assert (sample.crossed, sample.fallen) == (crossed, False)


def test_flat_ground_has_no_end(still_file, terrain):
    driver = drive(still_file, terrain, "flat")
    driver.data.qpos[0] = 100.0
    assert not driver.step().crossed


def test_a_script_goes_on_in_the_middle_and_counts(still_file, terrain):
    """Kicked over the edge of the tile once."""
    driver = drive(still_file, terrain, "bars", 0)
    step, pushed = driver.step, []

    def kicked():
        if len(pushed) == 3:
            driver.data.qpos[0] = 3.8
        pushed.append(1)
        return step()

    driver.step = kicked
    trace = record(driver, [Segment(0.4, "walk", (0.3, 0, 0))])
    assert trace.crossed.tolist() == [False] * 3 + [True] + [False] * 16
    assert abs(trace.qpos[4, 0]) < 0.05
    assert (trace.terrain, trace.title) == ("bars:0:0", "solo8 on bars:0:0, 0.4 s")
    (row,) = summarize(trace, driver.metadata)
    assert (row.crossings, row.falls) == (1, 0)


def trajectory(driver):
    driver.set_task("pitch_down", (0.3, 0.0, 0.2))
    return np.array([driver.step().qpos for _ in range(50)])


def test_on_flat_ground_terrain_changes_nothing(exported, terrain):
    plain = Driver(OnboardPolicy(exported[2]))
    assert plain.model.ngeom == load_robot("solo8").spec().compile().ngeom
    back = drive(exported[2], terrain, "stairs_down", 9)
    back.show("flat")
    np.testing.assert_array_equal(trajectory(plain), trajectory(back))


def test_the_height_field_is_solid(still_file, terrain):
    """A robot that is dropped onto a slope does not sink into it."""
    driver = drive(still_file, terrain, "slopes", 3, UP)
    driver.data.qpos[0] = 2.0
    driver.data.qpos[2] += driver.ground_height((2.0, 0.0))
    for _ in range(50):
        driver.step()
    feet = np.array([driver.data.geom(name).xpos for name in driver.robot.foot_geoms])
    down, geom = np.array([0.0, 0.0, -1.0]), np.zeros(1, np.int32)
    group = np.array([1, 0, 0, 0, 0, 0], np.uint8)
    for foot in feet:
        above = mujoco.mj_ray(driver.model, driver.data, foot, down, group, 1, -1, geom)
        assert above > 0


def test_a_tile_that_is_not_there_leaves_the_robot_where_it_is(still_file, terrain):
    driver = drive(still_file, terrain, "stairs_up", 2)
    model = driver.model
    with pytest.raises(ConfigError, match="no terrain 'ice'"):
        driver.show("ice")
    assert driver.model is model
    assert driver.tile == Tile("stairs_up", 2)
    assert Driver(OnboardPolicy(still_file)).tile == FLAT
