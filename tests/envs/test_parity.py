"""MuJoCo-Warp against C MuJoCo: the same states and targets, hence the same motion.

C computes in float64, Warp in float32, whose relative precision is 6e-8. What that makes of
positions (below 3 m or rad), velocities (up to 10 m/s or rad/s), velocities of the feet (m/s) and
contact forces (up to 40 N) was measured: 5e-7, 3e-5, 5e-6 and 2e-4 over 20 control steps with
contacts. The tolerances are 20 times that: other processors round otherwise, and contacts amplify.
Any mistake in a field, a sensor or a delay shows as 1e-2 or more.
"""

import dataclasses
from unittest.mock import patch

import pytest
import torch

from kiras_rl.config import load_config
from kiras_rl.envs import make_env, model
from kiras_rl.envs.randomization import Randomizer, columns
from kiras_rl.schema import RandomizationConfig

TOLERANCES = {"qpos": 1e-5, "qvel": 6e-4, "foot_vel_w": 1e-4, "record": 4e-3}
NOTHING = {field.name: None for field in dataclasses.fields(RandomizationConfig)}


@pytest.fixture(params=["warp", pytest.param("cuda", marks=pytest.mark.gpu)])
def pair(request, simulations):
    return simulations("native"), simulations(request.param)


@pytest.fixture
def assert_parity(drill):
    """Compare what `Drill.run` returned."""
    feet = drill.scene.sensors.foot_vel_w

    def check(native, warp, factor=1.0):
        native, warp = (m | {"foot_vel_w": m["record"][..., feet]} for m in (native, warp))
        for name, atol in TOLERANCES.items():
            assert_near(warp[name], native[name], factor * atol, name)

    return check


def assert_near(actual, expected, atol, name):
    torch.testing.assert_close(
        actual, expected, rtol=0, atol=atol, msg=lambda text: f"{name}: {text}"
    )


def randomize(sim, drill, **ranges):
    """Draw new physics as the environment does, the same for every backend."""
    config = dataclasses.replace(load_config("solo8").env.randomization, **ranges)
    generator = torch.Generator().manual_seed(5)  # of the CPU: a GPU would draw other numbers
    random = {name: torch.rand(4, k, generator=generator) for name, k in columns(8).items()}
    random = {name: x.to(sim.device) for name, x in random.items()}
    Randomizer(config, drill.scene, sim, random).reset(drill.mask(sim, range(4)))


def test_one_control_step(pair, drill, assert_parity):
    for sim in pair:
        drill.begin(sim)
    native, warp = (drill.run(sim, drill.targets[:1]) for sim in pair)
    assert_parity(native, warp, factor=0.2)


def test_steps_with_contact(pair, drill, assert_parity):
    for sim in pair:
        drill.begin(sim)
    native, warp = (drill.run(sim) for sim in pair)
    feet, limbs = drill.scene.sensors.foot_force_w, drill.scene.sensors.limb_force_w
    assert native["record"][..., feet].abs().max() > 20.0  # N: more than the weight of the robot
    assert native["record"][..., limbs].abs().max() > 1.0
    assert_parity(native, warp)


def test_randomized_physics(pair, drill, assert_parity):
    motions = {}
    for sim in pair:
        drill.begin(sim)
        nominal = drill.run(sim)["qpos"]
        randomize(sim, drill)
        drill.begin(sim)
        motions[sim] = drill.run(sim)
        assert (motions[sim]["qpos"] - nominal).abs().amax(dim=(0, 2)).min() > 1e-2  # each world
    assert_parity(*motions.values())


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_delay_after_a_long_time(pair, drill, assert_parity, steps):
    """Warp counts time in float32, which no longer resolves 2 us after 16 s.

    With delays of exactly 1, 2 or 3 physics steps Warp then reads the wrong sample now and then,
    and this test fails.
    """
    motions = []
    for sim in pair:
        randomize(sim, drill, **NOTHING | {"action_delay": (steps, steps)})
        drill.begin(sim)
        for _ in range(810):  # 16.2 s; at rest, where rounding cannot grow
            sim.step(drill.hold.to(sim.device))
        motions.append(drill.run(sim))
    # Friction holds a robot at rest wherever rounding has let it slip to: 6e-6 m measured.
    assert_parity(*motions, factor=10.0)


def test_captured_launches_change_no_bit(build, simulations, drill):
    captured, eager = simulations("warp"), build("warp", capture=False)
    for sim in (captured, eager):
        randomize(sim, drill)
        drill.begin(sim)
    a, b = drill.run(captured), drill.run(eager)
    assert all((a[name] == b[name]).all() for name in a)


def test_constraints_overflow_world_by_world(build, drill):
    sim = build("warp", max_constraints=16)  # rows; joints take 8, four feet 16
    drill.begin(sim, lift=[1.0, 1.0, 0.0, 0.0])
    sim.step(drill.hold)
    assert sim.overflowed.tolist() == [False, False, True, True]
    assert not sim.diverged.any()


def test_contacts_overflow_all_at_once(build, drill):
    sim = build("warp", max_contacts=1)  # a world, of one pool
    drill.begin(sim, lift=0.0)
    sim.step(drill.hold)
    assert sim.overflowed.all()

    drill.begin(sim, lift=1.0)
    sim.step(drill.hold)
    assert not sim.overflowed.any()


@pytest.mark.gpu
@pytest.mark.filterwarnings("ignore:Synchronization debug mode is a prototype feature")
def test_cuda_step_waits_for_nothing(simulations, drill):
    sim = simulations("cuda")
    drill.begin(sim)
    target = drill.hold.to(sim.device)
    everywhere = torch.ones(4, dtype=torch.bool, device=sim.device)
    try:
        torch.cuda.set_sync_debug_mode("error")
        for _ in range(3):
            sim.step(target)
            sim.write_state(everywhere, sim.qpos, sim.qvel, target)
            sim.write_velocity(everywhere, sim.qvel)
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.fixture(scope="module")
def environments():
    """The whole environment, everything random, on both backends; episodes last 0.2 s."""
    # `elsewhere` of the conftest keeps MuJoCo's files away, `threads` the machine's cores free.
    common = ["num_envs=4", "sim.threads=1", "env.terminations.episode_length=0.2"]
    common += ["sim.solver_iterations=60"]
    with patch.object(model, "TOLERANCE", 1e-8):  # backends agree where their solvers converge
        return [
            make_env(load_config("solo8", [*common, f"sim.backend={backend}"]))
            for backend in ("native", "warp")
        ]


def test_environments_agree(environments):
    native, warp = environments
    compare_observations(native.get_observations(), warp.get_observations())
    # In other sequences a force may lie at the threshold of contact, on either side of it.
    generator = torch.Generator().manual_seed(4)
    resets = torch.zeros(4)
    for _ in range(25):
        actions = 2 * torch.rand(4, native.num_actions, generator=generator) - 1
        results = [env.step(actions) for env in environments]
        (obs_a, rewards_a, dones_a, extras_a), (obs_b, rewards_b, dones_b, extras_b) = results
        compare_observations(obs_a, obs_b)
        assert_near(rewards_b, rewards_a, 1e-4, "rewards")
        assert (dones_a == dones_b).all()
        assert (extras_a["time_outs"] == extras_b["time_outs"]).all()
        resets += dones_a
    assert (resets >= 2).all()
    assert native.sim.diverged.sum() == warp.sim.overflowed.sum() == 0


def compare_observations(native, warp):
    assert set(native.keys()) == set(warp.keys())
    for name in native.keys():  # noqa: SIM118, a TensorDict iterates over its rows
        assert_near(warp[name], native[name], 1e-4, name)
