"""kiras-collect: what is recorded is what the robots did, whoever computes it."""

from __future__ import annotations

import inspect
import json
import os
import re
import signal
import threading
from pathlib import Path

import mujoco
import numpy as np
import onnx
import pytest
import torch

from kiras_rl.config import config_to_dict, load_config
from kiras_rl.dataset import FORMATS, LABELS, DatasetError, load_dataset, save_dataset
from kiras_rl.deploy.metadata import METADATA_KEY
from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.envs import observations
from kiras_rl.export import export_policy
from kiras_rl.phases import FINETUNING, SKILL_LEARNING, phase_of
from kiras_rl.robots.robot import load_robot
from kiras_rl.tools.collect import main
from kiras_rl.tools.driving.collector import Plan, collect
from kiras_rl.tools.evaluation.evaluator import (
    evaluation_physics,
    make_evaluation_env,
    onboard_policy,
)

FORWARD = ((0.1, 0.5), (0.0, 0.0), (-0.2, 0.2))
ROBOT = load_robot("solo8")
ROUGH = (
    "slopes", "bars", "footholds", "stairs_up", "stairs_down", "pits", "plates", "ramps", "rough"
)  # fmt: skip


@pytest.fixture(scope="module")
def make_env():
    """Return a function that builds the evaluation environment of `smoke`, nominal or not."""

    def make(num_envs, nominal=True, duration=2.0, *overrides, phase=SKILL_LEARNING, tilt=60.0):
        config = load_config("smoke", ["sim.backend=native", *overrides])
        config = evaluation_physics(phase_of(config, phase).config, nominal)
        config.env.terminations.terms["tilted"]["angle"] = tilt
        return make_evaluation_env(config, num_envs, duration)

    return make


@pytest.fixture(scope="module")
def policy_file(make_env, make_metadata, make_policy, tmp_path_factory):
    """A policy of configuration `smoke` with random weights, which moves the legs a little."""
    config = config_to_dict(load_config("smoke", ["sim.backend=native"]))
    metadata = make_metadata(**make_env(1).describe(), provenance={"config": config, "seed": 7})
    path = tmp_path_factory.mktemp("policy") / "smoke.onnx"
    export_policy(make_policy(metadata, gain=0.2), metadata, path)
    return path


@pytest.fixture(scope="module")
def dataset(make_env, policy_file):
    """Two skills, two episodes each, of up to a second on nominal robots."""
    plan = Plan(("walk", "stilt"), 2, 1.0, FORWARD, seed=4)
    policy = onboard_policy(OnboardPolicy(policy_file))
    return collect(make_env(plan.num_envs), policy, plan, {"seed": 4})


def test_every_frame_has_its_labels(dataset):
    assert dataset.rate == 50.0
    assert dataset.num_episodes == 4
    assert [len(part) for part in dataset.episodes("action")] == 4 * [50]
    assert dataset.skill[::50].tolist() == [0, 0, 1, 1]
    assert not dataset.fallen.any()
    assert dataset.features["joint_torque"].names == ROBOT.joint_names
    assert set(dataset.features["joint_torque"].units) == {"N m"}
    for name, feature in dataset.features.items():
        assert len(feature.names) == len(feature.units) == dataset[name].shape[1]
        assert dataset[name].dtype == (bool if name == "foot_contact" else np.float32)


def test_an_episode_has_a_command_of_its_own(dataset):
    commands = np.stack([part[0] for part in dataset.episodes("command")])
    assert len(np.unique(commands[:, 0])) == 4
    for column, (low, high) in enumerate(FORWARD):
        assert (commands[:, column] >= low).all()
        assert (commands[:, column] <= high).all()
    assert all((part == part[0]).all() for part in dataset.episodes("command"))


def test_gravity_and_height_follow_from_the_pose_of_the_base(dataset):
    for quat, gravity in zip(
        dataset["base_quat_w"].astype(float), dataset["projected_gravity"], strict=True
    ):
        inverse, expected = np.zeros(4), np.zeros(3)
        mujoco.mju_negQuat(inverse, quat)
        mujoco.mju_rotVecQuat(expected, np.array([0.0, 0.0, -1.0]), inverse)
        np.testing.assert_allclose(gravity, expected, atol=1e-5)
    np.testing.assert_array_equal(dataset["base_height"][:, 0], dataset["base_pos_w"][:, 2])


def test_velocities_are_the_change_of_positions(dataset):
    """The mean of the velocities at both ends of a step, times its 20 ms: the trapezoidal rule."""
    ways, speeds = [], []
    for pos, vel, quat in zip(
        *map(dataset.episodes, ("base_pos_w", "base_lin_vel_h", "base_quat_w")), strict=True
    ):
        w, x, y, z = quat.T
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        cos, sin = np.cos(yaw), np.sin(yaw)
        world = np.stack([cos * vel[:, 0] - sin * vel[:, 1], sin * vel[:, 0] + cos * vel[:, 1]], 1)
        ways.append(pos[-1, :2] - pos[0, :2])
        speeds.append((world[1:] + world[:-1]).sum(axis=0) / 2 / dataset.rate)
    np.testing.assert_allclose(ways, speeds, atol=5e-3)
    before, after = dataset.transitions("joint_pos")["stilt"]
    vel_before, vel_after = dataset.transitions("joint_vel")["stilt"]
    moved, expected = after - before, (vel_before + vel_after) / 2 / 50
    assert np.corrcoef(moved.ravel(), expected.ravel())[0, 1] > 0.95


def test_features_of_the_imitation_are_named_and_scaled_as_they_say(dataset):
    phi = dict(zip(dataset.features["imitation"].names, dataset["imitation"].T, strict=True))
    units = dict(zip(*vars(dataset.features["imitation"]).values(), strict=True))
    gravity = dataset["projected_gravity"]
    np.testing.assert_allclose(phi["projected_gravity.x"], 3 * gravity[:, 0], rtol=1e-5)
    np.testing.assert_allclose(phi["base_height"], 10 * dataset["base_height"][:, 0], rtol=1e-5)
    np.testing.assert_array_equal(phi["skill.stilt"], dataset.skill == 1)
    for joint, q, q0 in zip(
        ROBOT.joint_names, dataset["joint_pos"].T, ROBOT.default_joint_pos, strict=True
    ):
        np.testing.assert_allclose(phi[f"joint_pos.{joint}"], q - q0, atol=1e-5)
    assert (units["base_height"], units["projected_gravity.x"]) == ("m / 10", "1 / 3")
    assert (units["joint_pos.FL_HFE"], units["skill.walk"]) == ("rad", "1")


def test_targets_follow_from_actions(dataset):
    expected = ROBOT.default_joint_pos + ROBOT.action_scale * dataset["action"]
    np.testing.assert_allclose(dataset["joint_target"], expected, atol=1e-5)


def test_torques_are_those_of_the_gains_towards_the_last_target(dataset):
    """They are of the last physics step, 5 ms before the positions: nearly the same."""
    target, _ = dataset.transitions("joint_target")["walk"]
    _, q = dataset.transitions("joint_pos")["walk"]
    _, qd = dataset.transitions("joint_vel")["walk"]
    _, torque = dataset.transitions("joint_torque")["walk"]
    expected = ROBOT.kp * (target - q) - ROBOT.kd * qd
    assert np.corrcoef(expected.ravel(), torque.ravel())[0, 1] > 0.95
    assert (np.abs(dataset["joint_torque"]) <= ROBOT.torque_limit * 1.0001).all()


@pytest.mark.parametrize("number", [0, 3])
def test_an_action_is_what_the_robot_would_answer_to_the_frame(dataset, policy_file, number):
    """On board the same numbers give the same targets, once its history holds recorded frames."""
    onboard = OnboardPolicy(policy_file)
    start = 50 * number
    onboard.reset(dataset["joint_pos"][start])
    for k in range(start, start + 50):
        target = onboard.step(
            dataset["joint_pos"][k],
            dataset["joint_vel"][k],
            dataset["base_quat_w"][k],
            dataset["base_ang_vel_b"][k],
            dataset["command"][k],
            dataset.skills[dataset.skill[k]],
        )
        if k - start > 4:  # frames of the history
            np.testing.assert_allclose(target, dataset["joint_target"][k], atol=1e-4)
        onboard.action = dataset["action"][k].astype(float)


def test_the_same_seed_gives_the_same_dataset_and_another_does_not(make_env, policy_file):
    env, policy = make_env(2, nominal=False), onboard_policy(OnboardPolicy(policy_file))
    first, again, other = (
        collect(env, policy, Plan(("walk", "crawl"), 1, 0.2, FORWARD, seed), {})
        for seed in (5, 5, 6)
    )
    for name in first.features:
        np.testing.assert_array_equal(first[name], again[name])
    assert not np.array_equal(first["joint_pos"], other["joint_pos"])
    assert not np.array_equal(first["command"], other["command"])


@pytest.mark.parametrize("name", FORMATS)
def test_what_is_read_back_is_what_was_recorded(dataset, name, tmp_path):
    save_dataset(dataset, tmp_path / "data", [name])
    read = load_dataset(tmp_path / "data")
    assert read.features == dataset.features
    for feature in dataset.features:
        np.testing.assert_array_equal(read[feature], dataset[feature])
    for label in LABELS:
        np.testing.assert_array_equal(getattr(read, label), getattr(dataset, label))


def test_an_episode_ends_before_the_fall_that_its_last_step_led_to(make_env):
    """Actions that are out of range are clipped, and throw the robots over."""
    plan = Plan(("walk",), 4, 2.0, FORWARD, seed=1)
    env = make_env(4, tilt=20.0)  # degrees: targets within joint limits throw them less far
    wild = 100.0 * torch.sign(torch.randn(200, 4, 8, generator=torch.Generator().manual_seed(0)))
    moves = iter(wild)
    dataset = collect(env, lambda obs: next(moves), plan, {})
    assert (np.abs(dataset["action"]) == 6.0).all()  # action_clip
    ends = dataset.fallen[dataset.done]
    assert ends.all()
    assert dataset.fallen.sum() == dataset.num_episodes == 4
    assert len(dataset) < 4 * 100
    assert (dataset["projected_gravity"][:, 2] < 0).all()  # the frame after the fall is not there


def test_robots_that_all_fall_at_once_leave_no_dataset(make_env):
    env = make_env(2, duration=0.02, tilt=0.0)  # degrees: nobody stands that straight
    with pytest.raises(DatasetError, match="no episodes: every robot fell"):
        collect(env, lambda obs: torch.zeros(2, 8), Plan(("walk",), 2, 0.1, FORWARD, 1), {})


@pytest.mark.parametrize(
    ("phase", "lengths"),
    # 1, 2, 3 m are recorded; the next metre leads out of the tile. Flat ground has no end.
    [(FINETUNING, [3, 10]), (SKILL_LEARNING, [10, 10])],
)
def test_a_robot_that_leaves_its_tile_is_done_without_a_fall(make_env, phase, lengths):
    rough = [f"finetuning.env.terrain.types.{name}=null" for name in ROUGH]
    env = make_env(2, True, 2.0, *rough, phase=phase)

    def carry_one(obs):
        qpos = env.sim.qpos.clone()
        qpos[0, 0] += 1.0
        every = torch.ones(2, dtype=torch.bool)
        env.sim.write_state(every, qpos, torch.zeros_like(env.sim.qvel), qpos[:, 7:])
        return torch.zeros(2, 8)

    plan = Plan(("walk",), 2, 0.2, FORWARD, seed=1)
    dataset = collect(env, carry_one, plan, {})
    assert [len(part) for part in dataset.episodes("action")] == lengths
    assert not dataset.fallen.any()


def test_every_term_of_an_observation_has_its_unit_or_none():
    terms = {
        name
        for name, function in inspect.getmembers(observations, inspect.isfunction)
        if list(inspect.signature(function).parameters) == ["view"]
    }
    without = {"projected_gravity", "skill", "last_action", "friction"}
    assert set(observations.UNITS) == terms - without


def test_the_documented_example_runs(dataset, tmp_path, monkeypatch, capsys):
    page = Path(__file__).parents[2] / "docs" / "datasets.md"
    (snippet,) = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    save_dataset(dataset, tmp_path / "walks")
    monkeypatch.chdir(tmp_path)
    exec(compile(snippet, page.name, "exec"), {})
    printed = capsys.readouterr().out
    assert "solo8 50.0 ('walk', 'stilt') 4 200" in printed
    assert "stilt (98, 17) (98, 17)" in printed  # two episodes of 50 frames


def test_the_page_describes_every_feature(dataset):
    page = Path(__file__).parents[2] / "docs" / "datasets.md"
    rows = re.findall(r"^\| (`\w+`.*?) \| [0-9JFD]", page.read_text(encoding="utf-8"), re.MULTILINE)
    assert set(re.findall(r"`(\w+)`", " ".join(rows))) == set(dataset.features)


# --- the command ---------------------------------------------------------------------------------

SHORT = ("--episodes", "1", "--duration", "0.2")


def test_the_command_writes_a_dataset_that_says_where_it_is_from(policy_file, tmp_path, capsys):
    out = tmp_path / "data"
    line = [str(policy_file), "--skills=crawl,walk", *SHORT, "--seed=3", f"--out={out}"]
    assert main([*line, "--command=0.2:0.4,0,0.1", "--format=both"]) == 0
    assert f"{out}: 20 frames at 50 Hz\n" in capsys.readouterr().out
    dataset = load_dataset(out)
    assert (dataset.robot, dataset.skills, dataset.rate) == ("solo8", ("crawl", "walk"), 50.0)
    assert dataset["imitation"][0, 4] == 1.0  # skill.crawl
    made = dataset.provenance
    assert made["policy"]["seed"] == 7
    assert made["options"]["seed"] == 3
    assert made["options"]["command"][0] == [0.2, 0.4]
    assert "--command=0.2:0.4,0,0.1" in made["command_line"]
    assert {"kiras-rl", "mujoco"} <= set(made["versions"])
    assert (out / "meta" / "info.json").is_file()


def test_on_terrain_heights_are_above_the_ground_and_headings_held(policy_file, tmp_path):
    line = [str(policy_file), "--skills=walk", "--episodes=4", "--duration=0.5", "--nominal"]
    assert main([*line, "--terrain=stairs_down:1", f"--out={tmp_path / 'a'}"]) == 0
    dataset = load_dataset(tmp_path / "a")
    above, level = dataset["base_height"][:, 0], dataset["base_pos_w"][:, 2]
    assert np.abs(level - above).max() > 0.01
    assert above == pytest.approx(0.2, abs=0.06)
    assert len(np.unique(dataset["command"][:, 2])) > 4
    start = [quat[0] for quat in dataset.episodes("base_quat_w")]
    assert np.std([2 * np.arctan2(q[3], q[0]) for q in start]) > 0.5  # any heading


@pytest.fixture
def nameless_file(policy_file, tmp_path):
    """The same policy, which does not say how it was trained."""
    model = onnx.load(policy_file)
    (entry,) = [entry for entry in model.metadata_props if entry.key == METADATA_KEY]
    entry.value = json.dumps(json.loads(entry.value) | {"provenance": {}})
    onnx.save(model, tmp_path / "nameless.onnx")
    return tmp_path / "nameless.onnx"


@pytest.fixture
def error_of(policy_file, tmp_path, capsys):
    """Run the command with some arguments, and return the one line that it says on stderr."""

    def run(*line, policy=policy_file, out=tmp_path / "out"):
        assert main([str(policy), f"--out={out}", *line]) == 2
        err = capsys.readouterr().err
        assert err.startswith("error: ")
        assert err.count("\n") == 1
        return err

    return run


def test_a_folder_that_holds_files_is_left_alone(error_of, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter").write_text("dear")
    assert "holds files, which are not overwritten" in error_of(out=tmp_path / "mine")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["letter"]


def test_mistakes_are_one_line_and_leave_nothing(error_of, nameless_file, tmp_path):
    (tmp_path / "run").mkdir()
    assert "holds none of policy.onnx, checkpoints/" in error_of(policy=tmp_path / "run")
    assert "unknown skill 'trot' in --skills; this policy has: walk" in error_of("--skills=trot")
    assert "no terrain 'sand'; there are: flat, " in error_of("--terrain=sand")
    assert "no terrain level 2; it goes from 0 to 1" in error_of("--terrain=stairs_up:2")
    assert "give TYPE[:LEVEL]" in error_of("--terrain=stairs_up:1:1")
    assert "provenance.config is missing" in error_of(policy=nameless_file)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "option",
    ["--command=fast", "--command=0.5:0.1", "--command=1:2:3", "--command=0,0,0,0",
     "--command=nan", "--episodes=0", "--episodes=x", "--duration=0", "--duration=inf",
     "--format=csv"],
)  # fmt: skip
def test_options_that_cannot_be_are_refused(option, tmp_path, capsys):
    with pytest.raises(SystemExit) as exit_:
        main(["--out", str(tmp_path / "out"), option])
    assert exit_.value.code == 2
    assert option.split("=")[0] in capsys.readouterr().err


def test_an_interrupt_leaves_nothing(tmp_path, capsys):
    """The shipped policy stands for hours, unless somebody presses Ctrl-C."""
    # Python leaves SIGINT ignored where it began so, as in the background of a shell.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    timer = threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT))
    line = ["--skills=walk", "--episodes=1", "--duration=36000", "--nominal", "--command=0"]
    timer.start()
    try:
        assert main([*line, "--out", str(tmp_path / "out")]) == 130
    finally:
        timer.join()
        signal.signal(signal.SIGINT, before)
    assert capsys.readouterr().err == "interrupted: nothing was written\n"
    assert list(tmp_path.iterdir()) == []
