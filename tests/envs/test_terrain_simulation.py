"""Tiles in physics: what `Ground` says is what robots and balls meet, on every backend."""

import dataclasses
import logging

import mujoco
import numpy as np
import pytest
import torch

from kiras_rl.config import load_config
from kiras_rl.envs.ground import Ground
from kiras_rl.envs.simulation.native import NativeSimulation
from kiras_rl.envs.terrain_geoms import add_terrain, terrain_geoms
from kiras_rl.envs.terrain_library import build_library
from kiras_rl.phases import FINETUNING, phase_of

BACKENDS = ["native", "warp", pytest.param("cuda", marks=pytest.mark.gpu)]
ALL = (0, 1, 2, 3)
SPACIOUS = {"max_contacts": 64, "max_constraints": 256, "max_ccd": 16}


@pytest.fixture(scope="session")
def library():
    """A gentle and a hard level, both directions, all types."""
    config = phase_of(load_config("base"), FINETUNING).config.env.terrain
    return build_library(dataclasses.replace(config, levels=2, variants=2))


@pytest.fixture(scope="session")
def tiles(library):
    """Four tiles with platforms of four heights: bars 0, plates 0.15, slopes 1.96, stairs 0.11."""
    names = ["bars", "footholds", "slopes", "stairs_down"]
    levels, variants = [1, 1, 1, 0], [0, 0, 1, 1]
    return torch.tensor(
        [
            library.index(library.types.index(name), level, variant)
            for name, level, variant in zip(names, levels, variants, strict=True)
        ]
    )


@pytest.fixture(scope="session")
def rough(make_drill, library):
    return make_drill(library)


@pytest.fixture(scope="session")
def rough_simulations(build, rough):
    """Return a function that hands out the one simulation of a backend, as new."""
    built = {}

    def get(name):
        if name not in built:
            room = {} if name == "native" else SPACIOUS
            sim = build(name, model=rough.scene.model, terrain=rough.scene.terrain, **room)
            built[name] = sim, sim.state_dict()
        sim, initial = built[name]
        sim.load_state_dict(initial)
        return sim

    return get


@pytest.fixture(params=BACKENDS)
def sim(request, rough_simulations):
    return rough_simulations(request.param)


@pytest.fixture
def ground(sim, library):
    return Ground(library, 4, sim.device)


def show(sim, ground, drill, tiles, worlds=ALL):
    mask, tiles = drill.mask(sim, worlds), tiles.to(sim.device)
    sim.write_terrain(mask, tiles)
    ground.write(mask, tiles)


def stand(sim, ground, drill, steps=40):
    """Put every robot onto its platform and hold its pose; return the heights of the bases."""
    drill.begin(sim, lift=ground.spawn_height + 0.002)
    start = sim.qpos[:, 2].clone()
    drill.run(sim, drill.hold.expand(steps, -1, -1))
    return start, sim.qpos[:, 2]


def test_every_world_has_its_own_tile(sim, ground, rough, tiles):
    show(sim, ground, rough, tiles)
    heights = ground.spawn_height.tolist()
    assert heights == pytest.approx([0.0, 0.15, 3.4 * np.tan(np.pi / 6) - 0.005, 0.11], abs=1e-5)
    start, end = stand(sim, ground, rough)
    assert (end - start).abs().max() < 0.03  # m; the motors give way, the ground does not
    assert not sim.overflowed.any()


def test_a_tile_is_rewritten_in_place(sim, ground, rough, tiles):
    show(sim, ground, rough, tiles)
    _, before = stand(sim, ground, rough)
    before = before.clone() - ground.spawn_height
    show(sim, ground, rough, tiles.roll(1), worlds=(0, 2))
    assert ground.tile.tolist() == [tiles[3], tiles[1], tiles[1], tiles[3]]
    _, after = stand(sim, ground, rough)
    after = after - ground.spawn_height
    torch.testing.assert_close(after, before, rtol=0, atol=2e-3)


def test_a_tile_is_part_of_the_state(sim, ground, rough, tiles):
    show(sim, ground, rough, tiles)
    rough.begin(sim, lift=ground.spawn_height + 0.3)
    saved = sim.state_dict()
    went_on = rough.run(sim)
    show(sim, ground, rough, tiles.flip(0))
    rough.run(sim)
    sim.load_state_dict(saved)
    again = rough.run(sim)
    for name in went_on:
        if sim.device.type == "cuda":  # alike until they land: edges tell rounding apart
            a, b = again[name][:10], went_on[name][:10]
            torch.testing.assert_close(a, b, rtol=0, atol=1e-3)
        else:
            assert (again[name] == went_on[name]).all(), name


WARP = pytest.mark.parametrize("name", ["warp", pytest.param("cuda", marks=pytest.mark.gpu)])


@WARP
def test_backends_agree_on_boxes(build, rough, library, tiles, name):
    terrain, bare = rough.scene.terrain, dataclasses.replace(library, grid=0 * library.grid)
    pos = terrain.fields["geom_pos"].copy()
    pos[:, -1, 2] = -50.0  # the height field
    terrain = dataclasses.replace(terrain, fields=terrain.fields | {"geom_pos": pos})
    native, warp = (
        drop(build(backend, model=rough.scene.model, terrain=terrain, **room), bare, rough, tiles)
        for backend, room in (("native", {}), (name, SPACIOUS))
    )
    feet = rough.scene.sensors.foot_force_w
    touched = native["record"][..., feet].abs().amax(dim=(0, 2, 3)) > 2.0  # N
    assert touched.all()
    torch.testing.assert_close(warp["qpos"], native["qpos"], rtol=0, atol=1e-5)


@WARP
def test_backends_agree_on_a_height_field(rough_simulations, rough, library, tiles, name):
    """C makes a contact for every prism that a geom meets, Warp four a geom at most.

    So motions part a little from the first contact on; without a height field, or with another, a
    robot would be 0.1 m or more from here.
    """
    slopes = torch.full_like(tiles, tiles[2])
    native, warp = (
        drop(rough_simulations(backend), library, rough, slopes) for backend in ("native", name)
    )
    torch.testing.assert_close(warp["qpos"][..., :3], native["qpos"][..., :3], rtol=0, atol=0.01)


def drop(sim, library, drill, tiles):
    """Let four robots fall onto obstacles and return their motion."""
    ground = Ground(library, 4, sim.device)
    show(sim, ground, drill, tiles)
    place_on_obstacles(sim, ground, drill)
    return drill.run(sim, drill.hold.expand(8, -1, -1))


def place_on_obstacles(sim, ground, drill):
    """Put the robots 1.5 m from the centre, their bodies above the highest ground there."""
    drill.begin(sim)
    qpos = sim.qpos.clone()
    qpos[:, 0] += 1.5
    axis = torch.linspace(-0.3, 0.3, 61, device=sim.device)
    around = torch.cartesian_prod(axis, axis)
    qpos[:, 2] += ground.heights(qpos[:, None, :2] + around).amax(dim=1)
    everywhere = drill.mask(sim, ALL)
    sim.write_state(everywhere, qpos, torch.zeros_like(sim.qvel), drill.hold.to(sim.device))


def test_balls_come_to_rest_on_the_ground(library):
    """Every tile in worlds of its own; a ball touches where ground and sphere together are highest.

    Balls fall through honey, hence straight and without bouncing.
    """
    radius, worlds = 0.03, 8 * library.size
    sim = balls(library, worlds, radius)
    ground = Ground(library, worlds, torch.device("cpu"))
    everywhere = torch.ones(worlds, dtype=torch.bool)
    tile = torch.arange(worlds) % library.size
    sim.write_terrain(everywhere, tile)
    ground.write(everywhere, tile)
    qpos = torch.tensor(sim.model.qpos0).float().repeat(worlds, 1)
    qpos[:, :2] = 7.6 * torch.rand(worlds, 2) - 3.8
    expected = touch(ground, qpos[:, :2], radius)
    qpos[:, 2] = expected + 0.01
    sim.write_state(everywhere, qpos, torch.zeros(worlds, 7), torch.zeros(worlds, 1))
    for _ in range(20):
        sim.step(torch.zeros(worlds, 1))
    rest = touch(ground, sim.qpos[:, :2], radius)
    sunk = rest - sim.qpos[:, 2]
    still = sim.qvel[:, :3].norm(dim=1) < 0.01  # m/s; the others are on their way down an edge
    assert still.float().mean() > 0.7
    assert sunk[still].abs().max() < 1e-3  # m; contacts are soft


def balls(library, worlds, radius):
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.integrator = 0.005, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0, 0, 0.05))
    add_terrain(spec, library)
    ball = spec.worldbody.add_body(pos=(0, 0, 1))
    ball.add_freejoint().damping = [20.0, 0.0, 0.0]
    geom = ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(radius, 0, 0), mass=1.0)
    geom.contype, geom.conaffinity = 0, 1
    fan = spec.worldbody.add_body(pos=(0, 0, 9))  # a simulation has actuators
    fan.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(0.01, 0, 0), contype=0, conaffinity=0)
    fan.add_joint(name="fan", type=mujoco.mjtJoint.mjJNT_HINGE)
    spec.add_actuator(name="fan", target="fan", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    spec.add_sensor(
        type=mujoco.mjtSensor.mjSENS_JOINTPOS, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname="fan"
    )
    model = spec.compile()
    return NativeSimulation(model, worlds, 4, threads=1, terrain=terrain_geoms(model, library))


def touch(ground, centres, radius):
    """Return the height of a ball's centre where it touches the ground, (N,)."""
    axis = torch.linspace(-radius, radius, 121)
    around = torch.cartesian_prod(axis, axis)
    around = around[around.norm(dim=1) < radius]
    heights = ground.heights(centres[:, None] + around)
    return (heights + (radius**2 - around.square().sum(1)).sqrt()).amax(dim=1)


def test_flat_scenes_carry_no_terrain(drill):
    assert drill.scene.terrain is None
    assert drill.scene.model.nhfield == 0
    assert (drill.scene.model.geom_type != mujoco.mjtGeom.mjGEOM_BOX)[1:].sum() == 12  # legs


def test_an_overflow_names_its_key_once(build, rough, library, tiles, caplog):
    room = SPACIOUS | {"max_ccd": 1}
    sim = build("warp", model=rough.scene.model, terrain=rough.scene.terrain, **room)
    ground = Ground(library, 4, sim.device)
    show(sim, ground, rough, tiles[2].expand(4))  # slopes: every foot meets the height field
    rough.begin(sim, lift=ground.spawn_height)
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            sim.step(rough.hold)
            assert sim.overflowed.any()
    (message,) = [record.message for record in caplog.records if "sim." in record.message]
    assert message.startswith("too few pairs with a height field, raise sim.max_ccd, in ")
