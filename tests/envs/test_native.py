"""The C backend against MuJoCo itself."""

import mujoco
import numpy as np
import pytest
import torch

from kiras_rl.envs.model import build_scene


def mj_step(model, qpos, targets, substeps=4):
    """Simulate one world with plain MuJoCo; return qpos and qvel (T, n), sensors (T, K, S)."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    states, sensors = [], []
    for target in targets:
        data.ctrl[:] = target
        for _ in range(substeps):
            mujoco.mj_step(model, data)
            sensors.append(data.sensordata.copy())
        states.append(np.concatenate([data.qpos, data.qvel]))
    qpos, qvel = np.split(np.stack(states).astype(np.float32), [model.nq], axis=1)
    record = np.stack(sensors).reshape(len(targets), substeps, -1)
    return qpos, qvel, record.astype(np.float32)


def test_is_mj_step(simulations, drill):
    sim = simulations("native")
    drill.begin(sim, lift=0.0)
    motion = drill.run(sim)
    for world in range(4):
        qpos, qvel, record = mj_step(drill.scene.model, drill.qpos[world], drill.targets[:, world])
        assert (motion["qpos"][:, world].numpy() == qpos).all()
        assert (motion["qvel"][:, world].numpy() == qvel).all()
        assert (motion["record"][:, world].numpy() == record).all()


@pytest.mark.parametrize("threads", [2, 3])
def test_threads_change_no_bit(build, simulations, drill, threads):
    motions = []
    for sim in (simulations("native"), build("native", threads=threads)):
        drill.set_delays(sim, [3, 2, 1, 0])
        drill.begin(sim)
        motions.append(drill.run(sim))
    assert all((motions[0][name] == motions[1][name]).all() for name in motions[0])


def test_leaves_the_model_as_it_was(build, drill):
    flags = drill.scene.model.opt.disableflags
    build("native")
    assert drill.scene.model.opt.disableflags == flags


def test_counts_lost_contacts(build, drill):
    spec = drill.robot.spec(visuals=False)
    spec.memory = 6000  # bytes: enough for a robot in the air
    for joint in spec.joints:
        joint.frictionloss = 0.0  # which takes more on the ground, where MuJoCo raises
    sim = build("native", model=spec.compile())
    drill.begin(sim, lift=[1.0, 1.0, 0.0, 0.0])
    sim.step(drill.hold)
    assert sim.overflowed.tolist() == [False, False, True, True]
    assert not sim.diverged.any()

    drill.begin(sim, lift=1.0)
    sim.step(drill.hold)
    assert not sim.overflowed.any()


def test_warnings_go_to_the_log(build, drill, caplog, capfd, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    sim = build("native", threads=2)
    drill.begin(sim)
    sim.write_velocity(torch.tensor([False, True, True, True]), sim.qvel * torch.nan)
    sim.step(drill.hold)
    assert sim.diverged.tolist() == [False, True, True, True]
    assert "Nan, Inf or huge value in QVEL" in caplog.text
    assert capfd.readouterr().out == ""
    assert list(tmp_path.iterdir()) == []


def test_needs_no_delay(build, drill):
    scene = build_scene(drill.robot, timestep=0.005, solver_iterations=10)
    sim = build("native", model=scene.model)
    drill.begin(sim, lift=0.0)
    motion = drill.run(sim)
    expected = mj_step(scene.model, drill.qpos[0], drill.targets[:, 0])
    for name, values in zip(("qpos", "qvel", "record"), expected, strict=True):
        assert (motion[name][:, 0].numpy() == values).all()
