"""The ghost: where it stands, and that the robot does not feel it."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.tools.driving.driver import Driver
from kiras_rl.tools.driving.viewer.stage import GHOST_GROUP, Stage, ghost_pose


def trajectory(policy_file, watched):
    driver = Driver(OnboardPolicy(policy_file))
    stage = Stage(driver) if watched else None
    driver.set_task("pitch_down", (0.3, 0.0, 0.2))
    rows = []
    for _ in range(50):
        rows.append(driver.step().qpos)
        if stage:
            stage.pose()
            mujoco.mj_forward(stage.model, stage.data)
    return np.array(rows)


def test_the_physics_is_the_same_with_and_without_a_ghost(exported):
    policy_file = exported[2]
    np.testing.assert_array_equal(trajectory(policy_file, True), trajectory(policy_file, False))


def test_the_ghost_is_seen_and_never_touched(still_file):
    model = Stage(Driver(OnboardPolicy(still_file))).model
    ghost = model.geom_group == GHOST_GROUP
    assert ghost.sum() > 20
    assert not model.geom_contype[ghost].any()
    assert not model.geom_conaffinity[ghost].any()
    assert (model.geom_rgba[ghost, 3] < 0.5).all()


def test_the_ghost_stands_at_the_robots_place_in_the_posture_asked_for(still_file):
    driver = Driver(OnboardPolicy(still_file))
    driver.set_task("pitch_down", (0, 0, 0))
    driver.data.qpos[:7] = (2.0, 3.0, 0.21, np.cos(0.4), 0, 0, np.sin(0.4))  # heading 0.8 rad
    stage = Stage(driver)
    stage.pose()
    mujoco.mj_kinematics(stage.model, stage.data)
    posture = driver.metadata.keyframes["pitch_down"]
    ghost = stage.data.body("ghost_base")
    np.testing.assert_allclose(ghost.xpos, (2.0, 3.0, posture.base_height))
    axes = ghost.xmat.reshape(3, 3)
    assert np.arctan2(axes[1, 0], axes[0, 0]) == pytest.approx(0.8)
    assert np.arcsin(-axes[2, 0]) == pytest.approx(posture.pitch)
    np.testing.assert_array_equal(stage.data.qpos[22:], posture.joint_pos)
    np.testing.assert_array_equal(stage.data.qpos[:15], driver.data.qpos)


def test_beside_is_to_the_left_of_the_heading(still_file):
    """Heading along the world's y: left is its -x."""
    posture = OnboardPolicy(still_file).metadata.keyframes["walk"]
    qpos = np.array([1.0, 2.0, 0.2, np.sqrt(0.5), 0, 0, np.sqrt(0.5), *posture.joint_pos])
    np.testing.assert_allclose(ghost_pose(qpos, posture, side=0.5)[:2], (0.5, 2.0), atol=1e-12)


def test_a_new_policy_for_the_same_robot_keeps_the_scene(still_file):
    stage = Stage(Driver(OnboardPolicy(still_file)))
    other = Driver(OnboardPolicy(still_file))
    assert stage.move_to(other) is stage
    other.data.qpos[0] = 5.0
    stage.pose()
    assert stage.data.qpos[0] == 5.0


def test_the_ghost_stands_on_the_ground_under_it(still_file, smooth_terrain):
    """From 1.5 to 1.8 m from the middle is the fourth step up, four risers of 12 cm high."""
    driver = Driver(OnboardPolicy(still_file), smooth_terrain)
    driver.show("stairs_up", level=9)
    stage = Stage(driver)
    driver.data.qpos[:3] = (1.65, 0.0, 3.0)
    stage.pose()
    assert stage.data.qpos[17] == pytest.approx(4 * 0.12 + driver.posture.base_height)


def test_another_ground_is_another_scene_with_the_terrain_in_it(still_file):
    driver = Driver(OnboardPolicy(still_file))
    flat = Stage(driver)
    driver.show("stairs_up", level=4)
    stage = flat.move_to(driver)
    assert stage is not flat
    assert stage.model.ngeom > flat.model.ngeom
    assert stage.move_to(driver) is stage


def test_a_plain_stage_leaves_out_what_is_slow_and_moves_alike(still_file):
    driver = Driver(OnboardPolicy(still_file))
    stage = Stage(driver)
    assert stage.model.light_castshadow.any()
    assert stage.move_to(driver) is stage
    plain = stage.move_to(driver, plain=True)
    assert plain is not stage
    assert not plain.model.light_castshadow.any()
    assert plain.move_to(driver, plain=True) is plain
    for each in (stage, plain):
        each.pose()
    np.testing.assert_array_equal(plain.data.qpos, stage.data.qpos)
