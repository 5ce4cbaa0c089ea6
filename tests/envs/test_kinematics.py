"""The environment's own kinematics of the feet against MuJoCo's."""

import mujoco
import numpy as np
import pytest
import torch

from kiras_rl.envs.kinematics import FootKinematics
from kiras_rl.robots.robot import RobotError, list_robots, load_robot

CPU = torch.device("cpu")


@pytest.fixture(params=list_robots())
def robot(request):
    return load_robot(request.param)


@pytest.fixture
def model(robot):
    return robot.spec(visuals=False).compile()


@pytest.fixture
def kinematics(robot, model):
    return FootKinematics(model, robot, CPU)


@pytest.fixture
def poses(model):
    """Return 50 poses anywhere in the world, (50, nq): joints up to half a turn either way."""
    random = np.random.default_rng(1)
    qpos = random.uniform(-np.pi, np.pi, (50, model.nq))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    return qpos


def by_mujoco(robot, model, qpos):
    """Return for one world the feet's centres (F, 3), the base's position and its rotation."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    feet = data.geom_xpos[[model.geom(foot).id for foot in robot.foot_geoms]]
    base = data.body(robot.base_body)
    return feet, base.xpos, base.xmat.reshape(3, 3)


def assert_near(actual, expected):
    """Compare lengths below 1 m; rounding to float32 makes 1e-7 of each."""
    expected = torch.tensor(np.array(expected), dtype=torch.float32)
    torch.testing.assert_close(actual, expected, rtol=0, atol=1e-6)


def test_a_foot_may_be_a_body_of_its_own_that_is_welded_on(robot):
    spec = robot.spec(visuals=False)
    for name in robot.foot_geoms:
        geom = next(geom for geom in spec.geoms if geom.name == name)
        shank, radius = geom.parent, float(geom.size[0])
        end = geom.pos.copy()
        spec.delete(geom)
        foot = shank.add_body(name=f"{name}_body", pos=end / 2)
        sphere = mujoco.mjtGeom.mjGEOM_SPHERE
        foot.add_geom(name=name, type=sphere, size=[radius, 0, 0], pos=end / 2)
    joint_pos = torch.tensor(robot.default_joint_pos).float()[None]
    models = (spec.compile(), robot.spec(visuals=False).compile())
    split, whole = (FootKinematics(model, robot, CPU).foot_pos_b(joint_pos) for model in models)
    torch.testing.assert_close(split, whole, rtol=0, atol=1e-6)


@pytest.mark.parametrize("what", ["body", "joint"])
def test_legs_whose_feet_would_be_elsewhere_are_refused(robot, what):
    spec = robot.spec(visuals=False)
    shank = next(geom for geom in spec.geoms if geom.name == robot.foot_geoms[0]).parent
    if what == "body":
        shank.quat = [0.99, 0.0, 0.14, 0.0]
    else:
        shank.joints[0].pos = [0.0, 0.0, 0.01]
    with pytest.raises(RobotError, match=r"a foot is \d.\d cm from where hinges"):
        FootKinematics(spec.compile(), robot, CPU)


def test_feet_are_where_mujoco_puts_them(robot, model, kinematics, poses):
    expected = []
    for qpos in poses:
        feet, base, rotation = by_mujoco(robot, model, qpos)
        expected.append((feet - base) @ rotation)
    assert_near(kinematics.foot_pos_b(torch.tensor(poses[:, 7:]).float()), expected)


def test_heights_follow_from_gravity_in_the_base_frame(robot, model, kinematics, poses):
    gravity, expected = [], []
    for qpos in poses:
        feet, base, rotation = by_mujoco(robot, model, qpos)
        gravity.append(-rotation[2])
        expected.append(feet[:, 2] - base[2] - robot.foot_radius)
    gravity = torch.tensor(np.array(gravity)).float()
    assert_near(kinematics.foot_height_b(gravity, torch.tensor(poses[:, 7:]).float()), expected)


def test_the_lowest_foot_below_a_pitched_base(robot, model, kinematics, poses):
    pitch = np.linspace(-1.5, 1.5, len(poses))  # rad
    expected = []
    for qpos, angle in zip(poses, pitch, strict=True):
        turned = np.concatenate([qpos[:3], (np.cos(angle / 2), 0, np.sin(angle / 2), 0), qpos[7:]])
        feet, base, _ = by_mujoco(robot, model, turned)
        expected.append(feet[:, 2].min() - base[2] - robot.foot_radius)
    joint_pos = torch.tensor(poses[:, 7:]).float()
    assert_near(kinematics.lowest_foot(torch.tensor(pitch).float(), joint_pos), expected)


def test_the_environment_knows_its_foot_heights_after_steps_and_resets(robot, build_env):
    """Falls, time-outs and pushes included: the feet belong to the state that is observed."""
    env = build_env(f"robot={robot.name}", "env.terminations.episode_length=0.2")
    ended = torch.zeros(env.num_envs)
    for _ in range(25):
        ended += env.step(2 * torch.rand(env.num_envs, env.num_actions) - 1)[2]
        worlds = [by_mujoco(robot, env.sim.model, qpos) for qpos in env.sim.qpos.numpy()]
        expected = [feet[:, 2] - robot.foot_radius for feet, _, _ in worlds]
        assert_near(env.robot.foot_height, expected)
    assert (ended >= 2).all()
