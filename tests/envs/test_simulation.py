"""What the environment counts on, from every physics backend."""

import mujoco
import numpy as np
import pytest
import torch

BACKENDS = ["native", "warp", pytest.param("cuda", marks=pytest.mark.gpu)]
ALL = (0, 1, 2, 3)


@pytest.fixture(params=BACKENDS)
def sim(request, simulations):
    return simulations(request.param)


@pytest.fixture
def assert_same_motion(sim):
    """Compare what `Drill.run` returned: bit for bit on a CPU; a GPU adds up in any order."""
    atol = 1e-3 if sim.device.type == "cuda" else 0.0

    def check(a, b, worlds=ALL):
        for name in a:
            x, y = a[name][:, worlds], b[name][:, worlds]
            torch.testing.assert_close(x, y, rtol=0, atol=atol, msg=name)

    return check


def change_physics(sim, drill, worlds):
    """Heavier base, other friction and gains, delayed targets."""
    mask = drill.mask(sim, worlds)
    factors = {"body_mass": 1.3, "geom_friction": 0.5, "actuator_gainprm": 1.2}
    for field, factor in factors.items():
        sim.write_field(field, mask, drill.nominal(sim, field) * factor)
    sim.write_field("body_ipos", mask, drill.nominal(sim, "body_ipos") + 0.01)
    sim.write_field("actuator_delay", mask, drill.nominal(sim, "actuator_delay") + 0.0075)


def test_starts_where_it_is_told_to(sim, drill):
    feet = drill.scene.sensors.foot_force_w
    drill.begin(sim, lift=0.1)
    in_the_air = drill.run(sim, drill.hold[None])["record"][..., feet]
    assert (in_the_air == 0).all()
    drill.begin(sim, lift=0.0)
    assert (sim.qpos.cpu() == drill.qpos).all()
    assert (sim.qvel == 0).all()
    # Each keyframe stands on the ground, with all feet.
    on_the_ground = drill.run(sim, drill.hold[None])["record"][..., feet]
    assert (on_the_ground[0, :, -1].unflatten(1, (4, 3)).norm(dim=2) > 0.5).all()  # N


def test_motion_repeats(sim, drill, assert_same_motion):
    drill.begin(sim)
    first = drill.run(sim)
    drill.begin(sim)
    assert_same_motion(first, drill.run(sim))


def test_a_written_world_forgets_its_past(sim, drill, assert_same_motion):
    drill.set_delays(sim, [3, 3, 3, 3])
    drill.begin(sim, lift=-0.001)  # into the ground: the solver starts from its last solution
    first = drill.run(sim)
    drill.begin(sim, worlds=(1, 3), lift=-0.001)
    assert_same_motion(first, drill.run(sim), worlds=(1, 3))


def test_writes_touch_no_other_world(sim, drill, assert_same_motion):
    drill.begin(sim)
    drill.run(sim)
    half_way = sim.state_dict()
    undisturbed = drill.run(sim)

    sim.load_state_dict(half_way)
    change_physics(sim, drill, worlds=(1,))
    drill.begin(sim, worlds=(1,))
    sim.write_velocity(drill.mask(sim, (3,)), sim.qvel + 0.5)
    motion = drill.run(sim)
    assert_same_motion(undisturbed, motion, worlds=(0, 2))
    for world in (1, 3):
        assert (motion["qpos"][:, world] - undisturbed["qpos"][:, world]).abs().max() > 1e-2


def test_delay_counts_physics_steps(sim, drill):
    drill.set_delays(sim, [0, 1, 2, 3])
    drill.begin(sim)
    held = drill.run(sim, drill.hold[None])["record"]
    drill.begin(sim)
    jumped = drill.run(sim, drill.hold[None] + 0.1)["record"]
    torques = drill.scene.sensors.joint_torque
    change = (jumped - held)[0, :, :, torques].abs().amax(dim=2)  # (N, K)
    first = (change > 0.1).int().argmax(dim=1)  # Kp of 5 N m/rad times 0.1 rad is 0.5 N m
    assert first.tolist() == [0, 1, 2, 3]


def test_record_holds_every_physics_step(sim, drill):
    drill.begin(sim)
    motion = drill.run(sim)
    feet = drill.scene.sensors.foot_vel_w
    # Sensors are taken before each integration: those of the first physics step belong to the state
    # after the control step before.
    before = sensors_of(drill.scene.model, motion["qpos"][:-1], motion["qvel"][:-1])[..., feet]
    torch.testing.assert_close(motion["record"][1:, :, 0, feet], before, rtol=0, atol=1e-5)
    changed = motion["record"][..., feet].diff(dim=2).abs().amax(dim=(0, 1, 3))
    assert (changed > 1e-2).all()  # m/s, between physics steps


def sensors_of(model, qpos, qvel):
    """Return what plain MuJoCo measures in each state, (T, N, S)."""
    data, record = mujoco.MjData(model), []
    for position, velocity in zip(qpos.flatten(0, 1), qvel.flatten(0, 1), strict=True):
        data.qpos[:], data.qvel[:] = position, velocity
        mujoco.mj_forward(model, data)
        record.append(data.sensordata.copy())
    return torch.tensor(np.array(record)).float().unflatten(0, qpos.shape[:2])


@pytest.mark.parametrize("worlds", [(), (0, 2), ALL])
def test_resumes_exactly(sim, drill, assert_same_motion, worlds):
    change_physics(sim, drill, worlds)
    drill.begin(sim)
    drill.run(sim)
    saved = sim.state_dict()
    went_on = drill.run(sim)

    change_physics(sim, drill, ALL)  # another present, in which the saved state must leave no trace
    drill.begin(sim)
    drill.run(sim, drill.targets.flip(0))
    sim.load_state_dict(saved)
    assert_same_motion(went_on, drill.run(sim))


@pytest.mark.parametrize("what", ["velocity", "position", "target"])
def test_a_world_that_is_not_a_number_is_flagged_alone(sim, drill, assert_same_motion, what):
    drill.set_delays(sim, [0, 1, 2, 3])
    drill.begin(sim)
    undisturbed = drill.run(sim)

    drill.begin(sim)
    targets = drill.targets.clone()
    if what == "target":
        targets[0, 2] = torch.nan
    else:
        qpos, qvel = sim.qpos.clone(), sim.qvel.clone()
        {"velocity": qvel, "position": qpos}[what][2, 10] = torch.nan  # a joint
        sim.write_state(drill.mask(sim, (2,)), qpos, qvel, drill.hold.to(sim.device))
    disturbed = drill.run(sim, targets)
    assert disturbed["diverged"].any(dim=0).tolist() == [False, False, True, False]
    assert_same_motion(undisturbed, disturbed, worlds=(0, 1, 3))

    drill.begin(sim)
    assert_same_motion(undisturbed, drill.run(sim))


def test_a_huge_velocity_diverges(sim, drill):
    drill.begin(sim)
    qvel = sim.qvel.clone()
    qvel[1, 0] = 1e12  # finite, but beyond MuJoCo's limit of 1e10
    sim.write_velocity(drill.mask(sim, (1,)), qvel)
    sim.step(drill.hold.to(sim.device))
    assert sim.diverged.tolist() == [False, True, False, False]
