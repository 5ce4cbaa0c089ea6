"""Domain randomization: each row of the table reaches the model, and the robot's motion."""

from __future__ import annotations

import copy

import mujoco
import pytest
import torch

from kiras_rl.envs.simulation.base import RANDOMISED_FIELDS
from kiras_rl.robots.robot import load_robot

KP, KD = 4, 6  # columns of a DC motor's gainprm
MASS = 2.179  # kg, all of Solo-8
GRAVITY = 9.81  # m/s^2
EXACT = ("env.skills.joint_noise=0", "env.skills.velocity_noise=0")


@pytest.fixture
def build(build_env, nominal):
    """Return a function that builds worlds with some rows of the table and no other."""

    def build_with(*extra, num_envs=8, **rows):
        overrides = [f"env.randomization.{row}={value}" for row, value in rows.items()]
        return build_env(*nominal, *overrides, *EXACT, *extra, num_envs=num_envs)

    return build_with


def field(env, name):
    """Return a model field of every world."""
    return env.sim.state_dict()[f"field/{name}"].float()


def sensor(env, kind):
    """Return the sensors of a kind in every physics step of the last control step, (N, K, ...)."""
    model = env.sim.model
    sensors = [model.sensor(i) for i in range(model.nsensor)]
    chosen = [s for s in sensors if s.name.startswith(f"{kind}/")]
    columns = [int(s.adr[0]) + i for s in chosen for i in range(int(s.dim[0]))]
    return env.sim.sensor_record[:, :, columns].clone()


def start(env, skill="walk"):
    """Put every world into one keyframe, at rest, commanded to stand."""
    skills = torch.full((env.num_envs,), env.skills.index(skill))
    env.reset(skills, torch.zeros(env.num_envs, 3))


def hold(env):
    """Return the actions that ask for the joints' present angles."""
    robot = load_robot("solo8")
    return (env.robot.joint_pos - torch.tensor(robot.default_joint_pos).float()) / 0.5


def stand(env, steps=60):
    """Stand until the robot has come to rest."""
    start(env)
    actions = hold(env)
    for _ in range(steps):
        env.step(actions)


# --- the model -----------------------------------------------------------------------------------


def test_every_world_draws_its_own_physics_within_the_ranges(build_env):
    env = build_env(num_envs=200)
    nominal, base = env.sim.model, env.sim.model.body("base").id
    geoms = [env.sim.model.geom(name).id for name in load_robot("solo8").foot_geoms]
    gains = field(env, "actuator_gainprm")
    strength = gains[:, :, [KP, KD]] / torch.tensor([5.0, 0.1])
    links = [env.sim.model.body(i).id for i in range(base + 1, env.sim.model.nbody)]
    mass, inertia = field(env, "body_mass"), field(env, "body_inertia")
    drawn = {
        (0.5, 1.25): field(env, "geom_friction")[:, geoms, 0],
        (-0.5, 0.25): mass[:, base] - nominal.body_mass[base],
        (-0.02, 0.05): field(env, "body_ipos")[:, base] - torch.tensor(nominal.body_ipos[base]),
        (0.8 * 0.9, 1.2 * 1.1): strength[..., 0],
        (0.8 * 0.9 - 1e-6, 1.2 * 1.1): strength[..., 1],
        (0.9, 1.1): mass[:, links] / torch.tensor(nominal.body_mass[links]),
        (0.9 - 1e-6, 1.1): inertia[:, links] / torch.tensor(nominal.body_inertia[links]),
        (0.5, 2.0): field(env, "dof_frictionloss")[:, 6:] / 0.0477,
        (0.5 - 1e-6, 2.0): field(env, "dof_damping")[:, 6:] / 1.35e-4,
    }
    for (low, high), values in drawn.items():
        margin = 0.06 * (high - low)  # few products of two draws lie near their ends
        assert low - 2e-4 <= values.min() <= low + margin
        assert high - margin <= values.max() <= high + 2e-4
    delay = field(env, "actuator_delay")[:, 0] / 0.005
    steps, counts = delay.ceil().unique(return_counts=True)
    assert steps.tolist() == [0, 1, 2, 3]
    assert counts.min() > 25


def test_physics_is_drawn_anew_at_a_reset_and_stays_until_then(build_env):
    env = build_env("env.terminations.random_first_length=false")
    env.episode_length_buf = env.max_episode_length - torch.arange(8)  # world 7 ends in 7 steps
    env.reset()
    names = ("geom_friction", "body_mass", "body_ipos", "actuator_gainprm", "dof_frictionloss")
    env.episode_length_buf = torch.where(torch.arange(8) == 3, env.max_episode_length - 1, 0)
    before = {name: field(env, name) for name in names}
    env.step(hold(env))
    for name in names:
        changed = (field(env, name) != before[name]).flatten(1).any(dim=1)
        assert changed.tolist() == [i == 3 for i in range(8)], name


def test_constants_follow_from_the_masses(build_env):
    env = build_env(num_envs=4)
    model, data = copy.copy(env.sim.model), mujoco.MjData(env.sim.model)
    for world in range(4):
        model.body_mass[:] = field(env, "body_mass")[world].numpy()
        model.body_ipos[:] = field(env, "body_ipos")[world].numpy()
        model.body_inertia[:] = field(env, "body_inertia")[world].numpy()
        mujoco.mj_setConst(model, data)
        for name in ("body_subtreemass", "body_invweight0", "dof_invweight0"):
            expected = torch.tensor(getattr(model, name)).float()
            torch.testing.assert_close(field(env, name)[world], expected, rtol=1e-5, atol=0)


def test_without_randomization_physics_is_nominal(build):
    env = build()
    for name in RANDOMISED_FIELDS:
        nominal = torch.tensor(getattr(env.sim.model, name)).float()
        assert torch.equal(field(env, name), nominal.expand(8, *nominal.shape)), name


def test_a_share_of_the_episodes_is_randomized(build_env):
    env = build_env("env.randomized_share=[[0,0],[1,0.5]]", num_envs=200)  # at the end of a phase
    friction = field(env, "geom_friction")[:, env.sim.model.geom("FL_foot").id, 0]
    delay, gain = field(env, "actuator_delay")[:, 0], field(env, "actuator_gainprm")[:, 0, KP]
    mass = field(env, "body_mass")[:, env.sim.model.body("base").id]
    model = env.sim.model
    nominal = (friction == model.geom_friction[model.geom("FL_foot").id, 0]) & (delay == 0)
    nominal &= (gain == 5.0) & (mass == torch.tensor(model.body("base").mass).float())
    assert nominal.float().mean().item() == pytest.approx(0.5, abs=0.11)
    exact = (env._sensors.errors == 0).all(dim=1)
    assert torch.equal(exact, nominal)
    env.set_progress(0.0)
    env.reset()
    assert torch.equal(field(env, "actuator_gainprm")[:, 0, KP], torch.full((200,), 5.0))
    assert (env._sensors.errors == 0).all()
    proprio = env.get_observations()
    assert torch.equal(proprio["proprio"], env._observer.clean)  # without noise


# --- the motion ----------------------------------------------------------------------------------


def first_torque(env, action=0.2):
    """Return the torques of the first physics step after a small change of the targets."""
    start(env)
    env.step(hold(env) + action)
    return sensor(env, "torque")[:, 0]


def test_stiffer_springs_pull_harder(build):
    # kp 5 N m/rad, 0.2 * 0.5 rad away
    torch.testing.assert_close(first_torque(build()), torch.full((8, 8), 0.5))
    stiff = first_torque(build(kp_factor="[1.2,1.2]"))
    torch.testing.assert_close(stiff, torch.full((8, 8), 0.6))


def test_weaker_motors_give_less_torque(build):
    # The target is far away: 1.8 N m is the limit.
    torch.testing.assert_close(first_torque(build(), 8.0).amax(), torch.tensor(1.8))
    weak = first_torque(build(torque_factor="[0.5,0.5]"), 8.0)
    torch.testing.assert_close(weak.amax(), torch.tensor(0.9))


def test_each_motor_has_its_own_strength(build):
    torque = first_torque(build(motor_factor="[0.9,1.1]")) / 0.5
    assert (torque >= 0.9).all() and (torque <= 1.1).all()
    assert (torque.std(dim=1) > 0.01).all()  # of the joints of a world


def coasting(env):
    """Return joint velocities after 20 ms without torque, begun at 2 rad/s in the air, (N, J)."""
    start(env)
    qpos, qvel = env.sim.qpos.clone(), torch.zeros_like(env.sim.qvel)
    qpos[:, 2], qvel[:, 6:] = 1.0, 2.0
    everywhere = torch.ones(env.num_envs, dtype=torch.bool)
    env.sim.write_state(everywhere, qpos, qvel, qpos[:, 7:])
    gains = field(env, "actuator_gainprm")
    gains[..., [KP, KD]] = 0.0
    env.sim.write_field("actuator_gainprm", everywhere, gains)
    env.step(torch.zeros(env.num_envs, 8))
    return env.sim.qvel[:, 6:]


@pytest.mark.parametrize("kind", ["joint_friction_factor", "joint_damping_factor"])
def test_joints_that_rub_slow_down(build, kind):
    factor = {"joint_friction_factor": 3.0, "joint_damping_factor": 300.0}[kind]
    free = coasting(build(**{kind: "[0.0,0.0]"}))
    rubbed = coasting(build(**{kind: f"[{factor},{factor}]"}))
    assert (rubbed.abs() < free.abs() - 0.05).all()


def test_heavier_legs_weigh_on_the_feet(build):
    env = build(leg_mass_factor="[1.5,1.5]")
    stand(env)
    force = sensor(env, "foot")[:, -1].unflatten(1, (4, 3))[..., 2].sum(dim=1).abs()
    legs = 4 * (0.14853845 + 0.03763607)
    expected = torch.full((8,), (MASS + 0.5 * legs) * GRAVITY)
    torch.testing.assert_close(force, expected, rtol=0.02, atol=0)


def test_stronger_dampers_brake_harder(build):
    for factor, torque in (("null", -0.2), ("[0.8,0.8]", -0.16)):
        env = build(kd_factor=factor)
        start(env)
        turning = torch.zeros_like(env.sim.qvel)
        turning[:, 6:] = 2.0  # rad/s against kd 0.1 N m s/rad
        env.sim.write_velocity(torch.ones(8, dtype=torch.bool), turning)
        env.step(hold(env))
        expected = torch.full((8, 8), torque)
        torch.testing.assert_close(sensor(env, "torque")[:, 0], expected)


@pytest.mark.parametrize("delay", [0, 1, 2, 3])
def test_targets_arrive_late_by_whole_physics_steps(build, delay):
    env = build(action_delay=f"[{delay},{delay}]")
    start(env)
    held = hold(env)
    env.step(held)  # nothing moves but for the fall of 2 mm
    before = sensor(env, "torque")[:, -1]
    env.step(held + 0.7)  # 0.35 rad: 1.75 N m more
    change = (sensor(env, "torque") - before[:, None]).abs().mean(dim=(0, 2))
    assert (change > 0.3).tolist() == [k >= delay for k in range(4)]


def test_the_first_delayed_targets_hold_the_pose(build):
    env = build(action_delay="[3,3]")
    start(env, "crawl")  # far from the angles 0 that an empty delay would ask for
    env.step(hold(env) + 0.2)
    assert sensor(env, "torque")[:, 0].abs().max() < 1e-5


@pytest.mark.parametrize("payload", [-0.5, 0.0, 0.25])
def test_a_payload_weighs_on_the_feet(build, payload):
    env = build(payload=f"[{payload},{payload}]")
    stand(env)
    force = sensor(env, "foot")[:, -1].unflatten(1, (4, 3))[..., 2].sum(dim=1).abs()
    expected = torch.full((8,), (MASS + payload) * GRAVITY)
    torch.testing.assert_close(force, expected, rtol=0.02, atol=0)


def test_the_feet_next_to_the_centre_of_mass_carry_more(build):
    share = []
    for shift in ("null", "[0.05,0.05]"):
        env = build(com_shift=shift)
        stand(env)
        force = sensor(env, "foot")[:, -1].unflatten(1, (4, 3))[..., 2].abs()
        share.append((force[:, :2].sum(dim=1) / force.sum(dim=1)).mean().item())
    # The trunk moves by 5 cm of the 38 cm between the feet; it is two thirds of the robot.
    assert share[1] - share[0] == pytest.approx(0.05 / 0.38 * 1.43 / MASS, abs=0.04)


@pytest.mark.parametrize("friction", [0.1, 0.2])
def test_a_pushed_robot_slides_as_far_as_its_friction_lets_it(build, friction):
    env = build(friction=f"[{friction},{friction}]")
    start(env, "crawl")
    actions = hold(env)
    for _ in range(20):
        env.step(actions)
    before, shove = env.sim.qpos[:, 0].clone(), env.sim.qvel.clone()
    shove[:, 0] = 1.0
    env.sim.write_velocity(torch.ones(8, dtype=torch.bool), shove)
    for _ in range(60):
        env.step(actions)
    # Coulomb: v^2 / (2 mu g); the legs swallow a little of it
    expected = 1.0 / (2 * friction * GRAVITY)
    slid = (env.sim.qpos[:, 0] - before).mean().item()
    assert slid == pytest.approx(expected, rel=0.12)


def pushes(env, steps):
    """Return what was added to the velocity between judging and observing, (T, N, 2)."""
    start(env)
    actions, added = hold(env), []
    for _ in range(steps):
        env.step(actions)
        added.append((env.robot.base_lin_vel_h - env.measure().lin_vel_h)[:, :2])
    return torch.stack(added)


def test_a_push_adds_its_velocity_to_the_base(build):
    env = build("env.randomization.push_interval=0.02", push_velocity="[0.04,0.05]")
    added = pushes(env, 5)
    assert (added.norm(dim=-1) > 0.04 * 2**0.5 - 1e-4).all()
    assert (added.norm(dim=-1) < 0.05 * 2**0.5 + 1e-4).all()


def test_pushes_come_once_an_interval_on_average(build):
    env = build(
        "env.randomization.push_interval=0.2", push_velocity="[-0.1,0.1]", num_envs=100
    )  # fmt: skip
    added = pushes(env, 20)
    pushed = (added.norm(dim=-1) > 1e-6).float().mean().item()
    assert pushed == pytest.approx(0.1, abs=0.03)
    assert added.min() < -0.09 and added.max() > 0.09


def test_nobody_is_pushed_without_pushes(build):
    assert pushes(build(), 5).abs().max() == 0.0
