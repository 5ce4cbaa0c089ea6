"""What the scene of a robot measures."""

from __future__ import annotations

import mujoco
import numpy as np

from kiras_rl.envs.model import build_scene

LIMIT = 0.3  # N m, below the 1.8 of the actuators


def test_the_measured_torque_is_what_the_joint_gets_where_the_file_limits_it(edit_text):
    """Converters of URDF write the effort limit on the joint."""
    limit = f'actuatorfrcrange="-{LIMIT} {LIMIT}"'
    robot = edit_text(
        "solo8.xml", lambda text: text.replace("<joint axis", f"<joint {limit} axis", 1)
    )
    scene = build_scene(robot, timestep=0.005, solver_iterations=10)
    data = mujoco.MjData(scene.model)
    data.qpos[:] = robot.keyframes[0].qpos
    data.ctrl[:] = data.qpos[7:] + 100.0
    mujoco.mj_forward(scene.model, data)
    measured = data.sensordata[scene.sensors.joint_torque]
    np.testing.assert_allclose(measured, LIMIT)
    np.testing.assert_allclose(measured, data.qfrc_actuator[6:])
