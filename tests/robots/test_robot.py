"""Robots: their models against the numbers they come from, and a contract for every robot."""

import mujoco
import numpy as np
import pytest

from kiras_rl.robots.robot import list_robots, load_robot
from kiras_rl.robots.statics import check_keyframe, examine_keyframe

SKILLS = ("walk", "crawl", "stilt", "pitch_up", "pitch_down")


def compiled(robot, **arguments):
    return robot.spec(**arguments).compile()


def posed(model, qpos):
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    return data


def foot_bottoms(robot, model, data):
    feet = [model.geom(foot).id for foot in robot.foot_geoms]
    return data.geom_xpos[feet] - (0, 0, robot.foot_radius)


def inertia(body):
    """Return a body's inertia about its centre of mass in its own frame. Shape (3, 3), kg m^2."""
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, body.iquat)
    return axes.reshape(3, 3) @ np.diag(body.inertia) @ axes.reshape(3, 3).T


@pytest.fixture(params=list_robots())
def robot(request):
    return load_robot(request.param)


# Every robot


def test_arrays_follow_the_joints(robot):
    for name in ("default_joint_pos", "kp", "kd", "torque_limit", "action_scale"):
        values = getattr(robot, name)
        assert values.shape == (len(robot.joint_names),), name
        assert np.isfinite(values).all(), name
    assert (robot.kp > 0).all()
    assert (robot.torque_limit > 0).all()


def test_joint_order_is_the_same_everywhere(robot):
    model = compiled(robot)
    joints = [model.joint(i).name for i in range(1, model.njnt)]
    actuators = [model.actuator(i).name for i in range(model.nu)]
    assert list(robot.joint_names) == joints == actuators
    assert model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    assert model.nq == 7 + model.nu
    assert (model.actuator_trnid[:, 0] == np.arange(1, model.njnt)).all()


def test_actuators_are_position_controllers_with_a_torque_limit(robot):
    model = compiled(robot)
    data = posed(model, robot.keyframes[0].qpos)
    for velocity, error in ((0.0, 0.01), (0.5, -0.02), (-1.0, 0.03)):
        data.qvel[6:], data.ctrl[:] = velocity, data.qpos[7:] + error
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(data.actuator_force, robot.kp * error - robot.kd * velocity)
    data.qvel[6:], data.ctrl[:] = 0.0, data.qpos[7:] + 100.0
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.actuator_force, robot.torque_limit)


def test_torque_falls_with_speed_along_the_line_of_the_motor(robot):
    model = compiled(robot)
    data = posed(model, robot.keyframes[0].qpos)
    fast = robot.motor.no_load_speed * 0.9  # beyond the corner of limit and line
    for direction in (1, -1):
        data.qvel[6:] = direction * fast
        data.ctrl[:] = data.qpos[7:] + direction * 100.0
        mujoco.mj_forward(model, data)
        expected = 0.1 * robot.motor.stall_torque
        assert (expected < robot.torque_limit).all()
        np.testing.assert_allclose(direction * data.actuator_force, expected, rtol=1e-6)
        np.testing.assert_allclose(robot.motor.largest_torque(fast), expected)
    data.qvel[6:] = -fast  # braking: the voltage of the motion helps
    data.ctrl[:] = data.qpos[7:] + 100.0
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.actuator_force, robot.torque_limit)


def test_a_robot_without_motor_and_limits_has_none(edit):
    robot = edit("robot.yaml", motor=None, velocity_limit=None, joint_limits=None)
    np.testing.assert_array_equal(robot.velocity_limit, np.inf)
    np.testing.assert_allclose(robot.joint_limits, [[-3.1416, 3.1416]] * 8)
    model = compiled(robot)
    data = posed(model, robot.keyframes[0].qpos)
    data.qvel[6:], data.ctrl[:] = 1000.0, data.qpos[7:] + 1000.0
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.actuator_force, robot.torque_limit)


def test_a_variant_takes_the_place_of_some_keys(solo8):
    strong = load_robot("solo8:12A")
    assert strong.name == "solo8:12A"
    np.testing.assert_array_equal(strong.torque_limit, 2.5)
    np.testing.assert_array_equal(solo8.torque_limit, 1.8)
    np.testing.assert_array_equal(strong.kp, solo8.kp)
    assert strong.mjcf == solo8.mjcf


def test_physics_options(robot):
    option = compiled(robot).opt
    assert option.timestep == 0.005
    assert option.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert option.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    assert option.jacobian == mujoco.mjtJacobian.mjJAC_DENSE
    assert (option.iterations, option.ls_iterations) == (10, 10)


def test_geoms_are_floor_visual_or_collision(robot):
    model = compiled(robot)
    floor = model.geom("floor")
    assert (floor.group[0], floor.contype[0], floor.conaffinity[0]) == (0, 1, 0)
    named = {*robot.base_geoms, *robot.penalised_geoms, *robot.foot_geoms}
    for i in set(range(model.ngeom)) - {int(floor.id)}:
        geom = model.geom(i)
        collides = (geom.contype[0], geom.conaffinity[0], geom.priority[0]) == (0, 1, 1)
        visual = (geom.contype[0], geom.conaffinity[0]) == (0, 0)
        assert (geom.group[0], collides, visual) in {(3, True, False), (2, False, True)}, geom
        assert collides == (geom.name in named), f"{geom.name} is in no list of robot.yaml"


def test_without_visuals_the_physics_is_the_same(robot):
    full, bare = compiled(robot), compiled(robot, visuals=False)
    assert not (bare.geom_group == 2).any()
    heights = []
    for model in (full, bare):
        data = posed(model, robot.keyframes[0].qpos)
        data.ctrl[:] = robot.keyframes[0].joint_pos
        mujoco.mj_step(model, data, 100)
        heights.append(data.qpos[2])
    assert heights[0] == heights[1]


def test_default_pose_is_inside_the_joint_limits(robot):
    low, high = robot.joint_limits.T
    assert (low <= robot.default_joint_pos).all()
    assert (robot.default_joint_pos <= high).all()


def test_keyframes_are_the_five_skills_and_the_robot_can_hold_them(robot):
    assert robot.skills[:5] == SKILLS
    for keyframe in robot.keyframes:
        report = check_keyframe(robot, keyframe)
        assert np.abs(report.foot_height).max() < 1e-6
        assert report.leg_margin > 0


def test_keyframe_feet_are_below_their_hips(robot):
    model = compiled(robot)
    for keyframe in robot.keyframes:
        data = posed(model, keyframe.qpos)
        for foot in robot.foot_geoms:
            shank = int(model.geom(foot).bodyid[0])
            hip = data.xanchor[model.body_jntadr[model.body_parentid[shank]]]
            assert data.geom(foot).xpos[0] == pytest.approx(hip[0], abs=1e-6)


@pytest.mark.parametrize("skill", ["walk", "stilt"])
def test_gravity_compensated_targets_hold_the_pose(robot, skill):
    keyframe = robot.keyframe(skill)
    model = compiled(robot, visuals=False)
    data = posed(model, keyframe.qpos)
    data.ctrl[:] = keyframe.joint_pos + examine_keyframe(robot, keyframe).torque / robot.kp
    mujoco.mj_step(model, data, 200)  # 1 s
    assert data.qpos[2] == pytest.approx(keyframe.base_height, abs=1.5e-3)  # contacts give way
    assert 2 * np.arcsin(data.qpos[5]) == pytest.approx(keyframe.pitch, abs=np.deg2rad(0.5))
    assert np.abs(data.qpos[:2]).max() < 5e-3


def test_arrays_cannot_be_changed_by_accident(robot):
    with pytest.raises(ValueError, match="read-only"):
        robot.kp[0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        robot.keyframes[0].joint_pos[0] = 1.0


# Solo-8


def test_solo8_mass(solo8):
    legs = 4 * (0.14853845 + 0.03070001 + 0.00693606)  # thigh, shank, foot
    assert compiled(solo8).body_mass.sum() == pytest.approx(1.43315091 + legs, abs=1e-8)


def test_solo8_foot_positions(solo8):
    model = compiled(solo8)
    hip, knee = 0.7, -1.3
    data = posed(model, [0, 0, 0, 1, 0, 0, 0, *[hip, knee] * 4])
    for foot, (front, left) in zip(solo8.foot_geoms, [(1, 1), (1, -1), (-1, 1), (-1, -1)],
                                   strict=True):  # fmt: skip
        expected = (
            front * 0.190 - 0.16 * np.sin(hip) - 0.16 * np.sin(hip + knee),
            left * (0.1046 + 0.03745 + 0.008),
            -0.16 * np.cos(hip) - 0.16 * np.cos(hip + knee),
        )
        np.testing.assert_allclose(data.geom(foot).xpos, expected, atol=1e-3)


def test_solo8_mass_matrix_diagonal(solo8):
    model = compiled(solo8)
    data = posed(model, [0, 0, 0, 1, 0, 0, 0, *[0.0] * 8])
    matrix = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, matrix)
    armature = 4.47e-6 * 81
    shank = 1.491392e-4 + 0.03763607 * 0.102249**2
    thigh = 4.1193e-4 + 0.14853845 * (0.078707**2 + 1.377e-5**2)
    below = 1.491392e-4 + 0.03763607 * (0.16 + 0.102249) ** 2  # shank seen from the hip
    total = 2.17784899
    np.testing.assert_allclose(np.diag(matrix)[:3], total, rtol=1e-7)
    np.testing.assert_allclose(
        np.diag(matrix)[6:], [thigh + below + armature, shank + armature] * 4, rtol=1e-4
    )


def test_solo8_stands_24_cm_high_with_a_right_angle_in_the_knee(solo8):
    model = compiled(solo8)
    data = posed(model, [0, 0, 0, 1, 0, 0, 0, *[np.pi / 4, -np.pi / 2] * 4])
    height = 2 * 0.16 * np.cos(np.pi / 4) + 0.016
    np.testing.assert_allclose(foot_bottoms(solo8, model, data)[:, 2], -height, atol=1e-9)
    assert height == pytest.approx(0.2423, abs=1e-4)


# acos(length / 0.32) for a level base; front pair, hind pair, whose knees point forward
SOLO8_ANGLES = {
    "walk": (0.9582, -1.9164, -0.9582, 1.9164),
    "crawl": (1.2398, -2.4796, -1.2398, 2.4796),
    "stilt": (0.4789, -0.9578, -0.4789, 0.9578),
    "pitch_up": (1.0162, -1.5088, -0.8741, 2.2718),
    "pitch_down": (0.8741, -2.2718, -1.0162, 1.5088),
}


@pytest.mark.parametrize("skill", SKILLS)
def test_solo8_keyframes(solo8, skill):
    front_hip, front_knee, hind_hip, hind_knee = SOLO8_ANGLES[skill]
    expected = [front_hip, front_knee] * 2 + [hind_hip, hind_knee] * 2
    np.testing.assert_allclose(solo8.keyframe(skill).joint_pos, expected, atol=6e-5)


def test_solo8_keyframe_orientation(solo8):
    expected = (0.991445, 0, -0.130526, 0)  # 15 degrees nose up about y
    np.testing.assert_allclose(solo8.keyframe("pitch_up").quat, expected, atol=1e-6)
    np.testing.assert_allclose(solo8.keyframe("pitch_up").qpos[:7], [0, 0, 0.2, *expected],
                               atol=1e-6)  # fmt: skip


@pytest.mark.parametrize(
    ("knees", "front", "hind"),
    [("back", (1.0162, -1.5088), (1.3977, -2.2718)),
     ("forward", (-0.4926, 1.5088), (-0.8741, 2.2718))],
)  # fmt: skip
def test_knees_may_point_elsewhere(edit, knees, front, hind):
    robot = edit("keyframes.yaml", pitch_up={"base_height": 0.2, "pitch": -15, "knees": knees})
    np.testing.assert_allclose(
        robot.keyframe("pitch_up").joint_pos, [*front * 2, *hind * 2], atol=6e-5
    )


def test_solo8_static_torques(solo8):
    # measured by holding the poses in simulation: knees of a front and a hind leg, N m
    held = {"walk": (0.67, 0.67), "crawl": (0.77, 0.77), "stilt": (0.38, 0.38),
            "pitch_up": (0.57, 0.73), "pitch_down": (0.73, 0.57)}  # fmt: skip
    for skill, torques in held.items():
        report = check_keyframe(solo8, solo8.keyframe(skill))
        np.testing.assert_allclose(np.abs(report.torque[[1, 5]]), torques, atol=0.01)


def test_explicit_joint_angles(edit):
    angles = [0.8, -1.6] * 4
    height = 0.32 * np.cos(0.8) + 0.016
    robot = edit(
        "keyframes.yaml", rest={"base_height": float(height), "pitch": 0, "joint_pos": angles}
    )
    assert robot.skills == (*SKILLS, "rest")
    report = check_keyframe(robot, robot.keyframe("rest"))
    np.testing.assert_allclose(report.keyframe.joint_pos, angles)
    assert report.leg_margin == pytest.approx(0.32 - 0.32 * np.cos(0.8), abs=1e-9)


# Go1


def test_go1_mass(go1):
    leg = (0.591 + 0.089) + (0.920 + 0.089) + (0.135862 + 0.06)  # link + rotor, calf + foot
    assert compiled(go1).body_mass.sum() == pytest.approx(5.204 + 4 * leg, abs=1e-9)


def test_go1_foot_positions(go1):
    model = compiled(go1)
    thigh, calf = 0.9, -1.8
    data = posed(model, [0, 0, 0, 1, 0, 0, 0, *[0, thigh, calf] * 4])
    for foot, (front, left) in zip(go1.foot_geoms, [(1, -1), (1, 1), (-1, -1), (-1, 1)],
                                   strict=True):  # fmt: skip
        expected = (
            front * 0.1881 - 0.213 * (np.sin(thigh) + np.sin(thigh + calf)),
            left * (0.04675 + 0.08),
            -0.213 * (np.cos(thigh) + np.cos(thigh + calf)),
        )
        np.testing.assert_allclose(data.geom(foot).xpos, expected, atol=1e-3)
    assert -foot_bottoms(go1, model, data)[0, 2] == pytest.approx(0.2878, abs=1e-4)


def test_go1_mass_matrix_diagonal(go1):
    model = compiled(go1)
    data = posed(model, [0, 0, 0, 1, 0, 0, 0, *[0, 0.9, -1.8] * 4])
    matrix = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, matrix)
    diagonal = np.diag(matrix)
    np.testing.assert_allclose(diagonal[:3], 12.743448, rtol=1e-7)
    # the published models in this pose: base rotation, then one leg and its rotors' armature
    np.testing.assert_allclose(diagonal[3:6], [0.1315, 0.3987, 0.4230], atol=1e-4)
    calf = 1.497635e-3 + 0.195862 * (0.004299**2 + 0.146197**2)
    assert diagonal[8] == pytest.approx(calf + 1.11842e-4 * 81, rel=1e-4)
    rotor = 1.11842e-4 * 36
    np.testing.assert_allclose(diagonal[6:8] - rotor, [0.01780, 0.01709], atol=1e-4)


GO1_ANGLES = {
    "walk": (1.0088, -2.0176, 1.0088, -2.0176),
    "crawl": (1.2681, -2.5361, 1.2681, -2.5361),
    "stilt": (0.6957, -1.3914, 0.6957, -1.3914),
    "pitch_up": (1.1288, -1.7339, 1.4007, -2.2778),
    "pitch_down": (0.8771, -2.2778, 0.6052, -1.7339),
}


@pytest.mark.parametrize("skill", SKILLS)
def test_go1_keyframes(go1, skill):
    front_thigh, front_calf, rear_thigh, rear_calf = GO1_ANGLES[skill]
    expected = [0, front_thigh, front_calf] * 2 + [0, rear_thigh, rear_calf] * 2
    np.testing.assert_allclose(go1.keyframe(skill).joint_pos, expected, atol=6e-5)


def test_go1_action_zero_is_the_walk_pose(go1):
    np.testing.assert_array_equal(go1.default_joint_pos, go1.keyframe("walk").joint_pos)
    np.testing.assert_array_equal(go1.torque_limit, [23.7, 23.7, 35.55] * 4)


@pytest.mark.parametrize(
    ("name", "pairs"),
    [
        ("solo8", ["FL_thigh FR_thigh", "HL_thigh HR_thigh", "FL_shank FR_shank"]),
        ("go1", ["FL_hip FR_hip", "RL_hip RR_hip", "FL_thigh FR_thigh"]),  # its calves are equal
    ],
)
def test_left_and_right_mirror_each_other(name, pairs):
    model = compiled(load_robot(name))
    mirror = np.diag([1, -1, 1])
    # Solo-8's thighs are published turned by half a turn: x differs by 0.03 mm, Ixz by 2e-7
    for pair in pairs:
        left, right = (model.body(body) for body in pair.split())
        np.testing.assert_allclose(left.ipos, mirror @ right.ipos, atol=3e-5)
        np.testing.assert_allclose(inertia(left), mirror @ inertia(right) @ mirror, atol=2e-7)


def test_off_diagonal_inertias_keep_their_sign(solo8, go1):
    thigh = inertia(compiled(solo8).body("FL_thigh"))
    assert thigh[1, 2] == pytest.approx(4.671e-5, rel=1e-4)
    hips = compiled(go1)
    for leg, x, y in [("FL", 1, 1), ("FR", 1, -1), ("RL", -1, 1), ("RR", -1, -1)]:
        hip = inertia(hips.body(f"{leg}_hip"))
        expected = [-1.459e-5 * x * y, 1.246e-6 * x, 1.575e-6 * y]
        np.testing.assert_allclose(hip[[0, 0, 1], [1, 2, 2]], expected, atol=1e-9)
