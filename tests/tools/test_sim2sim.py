"""The second simulator against hand arithmetic, and its protocol from the command to the report."""

from __future__ import annotations

import csv
import html
import json

import mujoco
import numpy as np
import onnx
import pytest

from kiras_rl.deploy.metadata import METADATA_KEY
from kiras_rl.robots.robot import load_robot
from kiras_rl.robots.statics import examine_keyframe
from kiras_rl.tools.evaluate import main
from kiras_rl.tools.evaluation import sim2sim
from kiras_rl.tools.evaluation.sim2sim import Record, Simulator, Start, motor_torque
from kiras_rl.tools.shared.policy_files import load_policy, shipped_policy

SKILLS = ["walk", "crawl", "stilt", "pitch_up", "pitch_down"]


@pytest.fixture(scope="module")
def robot():
    return load_robot("solo8")


def still(robot, skill, friction=0.8):
    """Start in a keyframe, exactly."""
    keyframe = robot.keyframe(skill)
    return Start(keyframe, keyframe.joint_pos, heading=0.7, friction=friction, command=0.0)


@pytest.mark.parametrize(
    ("asked", "velocity", "given"),
    [
        (1.0, 0.0, 1.0),
        (3.0, 0.0, 1.8),  # the torque limit
        (3.0, 65.0, 1.452),  # 11.6 (1 - 65 / 74.3)
        (-3.0, -65.0, -1.452),
        (-3.0, 65.0, -1.8),  # braking
        (0.0, 80.0, -0.890),  # faster than its voltage lets it turn: it brakes
    ],
)
def test_a_motor_gives_what_its_line_and_its_limit_leave(robot, asked, velocity, given):
    torque = motor_torque(robot, np.full(8, asked), np.full(8, velocity))
    assert torque == pytest.approx(np.full(8, given), abs=1e-3)


@pytest.mark.parametrize("name", ["solo8", "go1"])
def test_motors_are_those_of_the_training(name):
    """MuJoCo's DC motor behind its position controller, at any state."""
    robot = load_robot(name)
    model = robot.spec(visuals=False).compile()
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(20):
        data.qpos[:] = robot.keyframes[0].qpos
        data.qvel[6:] = random.normal(0.0, 30.0, model.nu)
        data.ctrl[:] = data.qpos[7:] + random.normal(0.0, 1.0, model.nu)
        mujoco.mj_forward(model, data)
        asked = robot.kp * (data.ctrl - data.qpos[7:]) - robot.kd * data.qvel[6:]
        torque = motor_torque(robot, asked, data.qvel[6:])
        assert data.actuator_force == pytest.approx(torque, abs=1e-9)


@pytest.mark.parametrize("skill", ["walk", "stilt"])
def test_a_robot_that_holds_its_keyframe_stays(robot, skill):
    keyframe = robot.keyframe(skill)
    target = keyframe.joint_pos + examine_keyframe(robot, keyframe).torque / robot.kp
    simulator = Simulator(robot)
    simulator.place(still(robot, skill))
    for _ in range(500):
        simulator.step(target)
    data = simulator.data
    assert not simulator.has_fallen
    assert data.qpos[7:] == pytest.approx(keyframe.joint_pos, abs=0.03)
    assert data.qpos[:3] == pytest.approx((0.0, 0.0, keyframe.base_height), abs=0.005)
    assert np.abs(data.qvel).max() < 0.01
    assert simulator.foot_force.sum() == pytest.approx(simulator.model.body_mass.sum() * 9.81, 1e-3)


def test_friction_decides_whether_a_pushed_robot_slides(robot):
    """Coulomb's way is v^2 / (2 mu g): 0.20 m at 0.1, 0.025 m at 0.8; it rocks beside it."""
    ways = []
    for friction in (0.1, 0.8):
        simulator, start = Simulator(robot), still(robot, "crawl", friction)
        simulator.place(start)
        for step in range(900):
            if step == 300:  # it has settled
                simulator.data.qvel[0] += 0.63  # m/s
                begin = simulator.data.qpos[0]
            simulator.step(start.joint_pos)
        ways.append(simulator.data.qpos[0] - begin)
    assert ways[0] == pytest.approx(0.2, abs=0.04)
    assert ways[1] < 0.05


def test_a_robot_upside_down_has_fallen(robot):
    simulator = Simulator(robot)
    simulator.place(still(robot, "walk"))
    simulator.data.qpos[3:7] = 0.0, 1.0, 0.0, 0.0
    simulator.data.qpos[2] = 1.0
    simulator.step(robot.keyframe("walk").joint_pos)
    assert simulator.has_fallen
    simulator.place(still(robot, "walk"))
    simulator.data.qpos[2], simulator.data.qpos[7:] = 0.02, np.pi / 2  # the trunk is 5 cm thick
    simulator.step(np.full(8, np.pi / 2))  # with its legs level
    assert simulator.has_fallen


def test_physics_that_breaks_is_a_fall(robot):
    simulator = Simulator(robot)
    simulator.place(still(robot, "walk"))
    target = robot.keyframe("walk").joint_pos
    simulator.step(target)
    assert not simulator.has_fallen
    simulator.data.qvel[0] = 1e12
    simulator.step(target)
    assert simulator.has_fallen


def test_a_trial_is_drawn_alike_again(robot):
    keyframe = robot.keyframe("walk")
    first, again, other = (sim2sim.draw_start(keyframe, n, (0.3, 0.5)) for n in (1, 1, 2))
    assert first.friction == again.friction != other.friction
    assert np.array_equal(first.joint_pos, again.joint_pos)
    assert np.abs(first.joint_pos - keyframe.joint_pos).max() <= 0.05
    assert 0.5 <= first.friction <= 1.0 and first.command in (0.3, 0.5)


def test_loads_by_hand(robot):
    rows = 100  # two and a half control steps of 40
    qpos, qvel = np.zeros((rows, 15)), np.zeros((rows, 14))
    qpos[40:45, 7] = 1.5  # 1.45 is the limit; only the second control step sees it
    qpos[50:60, 8] = 3.0  # between two control steps
    qvel[7, 9] = -12.0
    torque = np.zeros((rows, 8))
    torque[3, 0], torque[4, 1] = -1.2, 0.9  # FL_HFE, FL_KFE
    asked = torque.copy()
    asked[3, 0] = -2.0
    none = np.zeros((rows, 4))
    record = Record(qpos, qvel, asked, torque, none, none, control_steps=40, has_fallen=False)
    assert sim2sim.loads([record], robot, robot.joint_limits) == {
        "beyond": pytest.approx(1 / 3),
        "saturated": pytest.approx(1 / 100),
        "peak_torque": {"HFE": 1.2, "KFE": 0.9},
        "peak_speed": 12.0,
    }
    nothing = record.counted(1.0)
    assert set(sim2sim.loads([nothing], robot, robot.joint_limits).values()) == {None}


def test_velocity_is_that_along_the_heading(robot):
    qpos, qvel = np.zeros((1, 15)), np.zeros((1, 14))
    yaw, pitch = 2.0, 0.2
    turn, lean = np.array([np.cos(1.0), 0, 0, np.sin(1.0)]), [np.cos(0.1), 0, np.sin(0.1), 0]
    mujoco.mju_mulQuat(qpos[0, 3:7], turn, np.array(lean))
    qvel[0, :2] = 0.3 * np.cos(yaw) - 0.1 * np.sin(yaw), 0.3 * np.sin(yaw) + 0.1 * np.cos(yaw)
    none = np.zeros((1, 8))
    walk = Record(qpos, qvel, none, none, none, none, 20, False).walk()
    assert walk.velocity == pytest.approx([0.3]) and walk.pitch == pytest.approx([pitch])


@pytest.mark.parametrize(
    ("name", "kind"), [("FL_HFE", "HFE"), ("RR_calf_joint", "calf"), ("knee", "knee")]
)
def test_joints_of_all_legs_are_of_one_kind(name, kind):
    assert sim2sim.joint_kind(name) == kind


def test_a_trial_goes_on_until_a_fall(robot, monkeypatch):
    policy = load_policy(None, "solo8")
    falls = iter([False] * 30 + [True])

    def step(self, target):
        self.has_fallen = next(falls)

    monkeypatch.setattr(Simulator, "step", step)
    record = sim2sim.run_trial(Simulator(robot), policy, still(robot, "walk"), 1.0)
    assert record.has_fallen and len(record.qpos) == 31 and record.control_steps == 20


def test_the_protocol_measures_the_shipped_policy(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sim2sim, "DURATION", 2.5)
    monkeypatch.setattr(sim2sim, "STANDING", 0.5)
    command = ["--protocol", "sim2sim", "--trials", "1", "--out", str(tmp_path)]
    assert main(command) == 0
    assert "Beside the physics of the training" in capsys.readouterr().out
    results = json.loads((tmp_path / "results.json").read_text())["results"]
    assert len(results) == len(SKILLS) + 1
    for skill in SKILLS:
        (values,) = (v for key, v in results.items() if f"skill={skill} " in key)
        walk = values["walk"]
        assert walk["falls"] == values["stand"]["falls"] == 0.0
        assert walk["height_error"] < 0.03 and walk["pitch_error"] < 0.1
        assert 0.1 < walk["velocity"] < 0.5
        assert 0.0 < walk["peak_torque"]["HFE"] <= 1.8
        assert values["stand"]["drift"] < 0.3
    table = tmp_path / "tables/sim2sim_beside_the_physics_of_the_training.csv"
    rows = list(csv.reader(table.read_text().splitlines()))[1:]
    assert [row[:2] for row in rows] == [[s, p] for s in SKILLS for p in ("training", "second")]
    for training, second in zip(rows[::2], rows[1::2], strict=True):
        assert float(second[4]) == pytest.approx(float(training[4]), abs=0.2)  # v_x, m/s
    page = html.unescape((tmp_path / "report.html").read_text())
    assert "the policy file's" in page


def test_an_older_policy_file_is_measured_by_the_limits_of_robot_yaml(tmp_path, monkeypatch):
    old = onnx.load(shipped_policy("solo8"))
    (entry,) = (prop for prop in old.metadata_props if prop.key == METADATA_KEY)
    entry.value = json.dumps(json.loads(entry.value) | {"joint_limits": None})
    onnx.save(old, tmp_path / "old.onnx")
    monkeypatch.setattr(sim2sim, "DURATION", 2.5)
    monkeypatch.setattr(sim2sim, "STANDING", 0.1)
    command = [str(tmp_path / "old.onnx"), "--protocol", "sim2sim", "--trials", "1"]
    assert main([*command, "--out", str(tmp_path)]) == 0
    page = html.unescape((tmp_path / "report.html").read_text())
    assert "robot.yaml's, because the policy file has none" in page
