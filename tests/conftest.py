"""The one policy of all tests: where they run, on how many threads, from which seed."""

from __future__ import annotations

import os
import shutil

import patience
import pytest
import torch
from tape import Tape

torch.set_num_threads(2)  # what CI has: the same order of sums, hence the same bits, on any machine


@pytest.fixture(scope="session")
def nominal():
    """Return the overrides that leave nothing of the physics and the sensors random."""
    from dataclasses import fields

    from kiras_rl.schema import RandomizationConfig

    kinds = [field.name for field in fields(RandomizationConfig)]
    return tuple(f"env.randomization.{kind}=null" for kind in kinds if kind != "push_interval")


@pytest.fixture(scope="session", autouse=True)
def elsewhere(tmp_path_factory):
    """Run outside the checkout: MuJoCo drops its log there, and no path may count on the folder."""
    start = os.getcwd()
    os.chdir(tmp_path_factory.mktemp("elsewhere"))
    yield
    os.chdir(start)


@pytest.fixture(autouse=True)
def seeded():
    """Give every test the same initial weights, whichever ran before it."""
    torch.manual_seed(0)


def pytest_runtest_setup(item):
    if item.get_closest_marker("gpu") and not torch.cuda.is_available():
        pytest.skip("needs CUDA")


def pytest_runtest_logreport(report):
    if report.failed:
        patience.spend(report.duration)


@pytest.fixture
def taped(monkeypatch):
    """Let a CPU record what a GPU would: torch.cuda's graphs are stand-ins."""
    monkeypatch.setattr(torch.cuda, "CUDAGraph", Tape)
    monkeypatch.setattr(torch.cuda, "graph", lambda tape: tape)


@pytest.fixture
def edit_text(tmp_path):
    """Return a function that changes the text of one file of a copied Solo-8 and loads the copy."""
    from kiras_rl.robots.robot import ROBOTS, load_robot

    def change(file, edit, name="solo8"):
        folder = shutil.copytree(ROBOTS / "solo8", tmp_path / "robots" / name, dirs_exist_ok=True)
        for other in ("robot.yaml", "keyframes.yaml", "solo8.xml"):
            shutil.copy(ROBOTS / "solo8" / other, folder)
        text = edit((folder / file).read_text(encoding="utf-8"))
        data = text if isinstance(text, bytes) else text.encode()
        (folder / file).write_bytes(data)
        if name != "solo8":
            (folder / "solo8.xml").rename(folder / f"{name}.xml")
        return load_robot(name, root=tmp_path / "robots")

    return change


@pytest.fixture(scope="session")
def build_env():
    """Return a function that builds an environment on C MuJoCo, with overrides."""
    from kiras_rl.config import load_config
    from kiras_rl.envs import make_env

    def build(*overrides, cfg="solo8", num_envs=8):
        shape = [f"num_envs={num_envs}", "device=cpu", "sim.backend=native"]
        return make_env(load_config(cfg, [*shape, *overrides]))

    return build


@pytest.fixture(scope="session")
def smoke_run(tmp_path_factory):
    """A finished run of cfg/smoke.yaml, for reading; copy it to go on with it."""
    from kiras_rl.tools.train import main

    runs, threads = tmp_path_factory.mktemp("runs"), torch.get_num_threads()
    torch.set_num_threads(1)  # eight worlds are faster on one, much faster on a busy machine
    assert main(["--cfg", "smoke", "--runs", str(runs)]) == 0
    torch.set_num_threads(threads)
    (run,) = (runs / "smoke").iterdir()
    return run


@pytest.fixture(scope="session")
def make_metadata():
    """Describe a policy of Solo-8 that observes every term a robot can rebuild."""
    from kiras_rl.deploy.metadata import PolicyMetadata
    from kiras_rl.robots.robot import load_robot

    terms = {
        "projected_gravity": (3, 1.0),
        "pitch": (1, 3.0),
        "base_ang_vel": (3, 0.25),
        "command_lin_vel_x": (1, 2.0),
        "command_lin_vel_y": (1, 4.0),
        "command_ang_vel_z": (1, 0.5),
        "skill": (5, 1.0),
        "joint_pos": (8, 1.5),
        "joint_vel": (8, 0.05),
        "last_action": (8, 0.1),
    }

    def make(**changes):
        robot = load_robot("solo8")
        values = {
            "format": 1,
            "robot": "solo8",
            "joint_names": robot.joint_names,
            "default_joint_pos": robot.default_joint_pos,
            "kp": robot.kp,
            "kd": robot.kd,
            "torque_limit": robot.torque_limit,
            "joint_limits": robot.joint_limits,
            "velocity_limit": robot.velocity_limit,
            "action_scale": robot.action_scale,
            "action_clip": 6.0,
            "observation": [
                {"name": name, "size": size, "scale": scale}
                for name, (size, scale) in terms.items()
            ],
            "history_length": 4,
            "skills": robot.skills,
            "keyframes": {frame.name: vars(frame) for frame in robot.keyframes},
            "control_rate": 50.0,
            "command_range": {
                "lin_vel_x": [-0.3, 0.6],
                "lin_vel_y": [0.0, 0.0],
                "ang_vel_z": [-0.6, 0.6],
            },
            "version": "0.1.0",
            "provenance": {"seed": 1},
            "onboard": robot.onboard,
        }
        return PolicyMetadata.from_dict(values | changes)

    return make


@pytest.fixture(scope="session")
def make_policy():
    """Build networks of the usual widths with random weights; `gain` scales their actions."""
    from kiras_rl.models.estimator import ContextEstimator
    from kiras_rl.models.exported import ExportedPolicy

    def make(metadata, gain=1.0, hidden=128, estimator=True):
        torch.manual_seed(1)
        frame, latent = metadata.frame_size, 8
        encoder = ContextEstimator(
            frame, metadata.history_length, len(metadata.skills), latent, [128, 64], [64, 128]
        )
        widths = frame + 3 + latent if estimator else frame + metadata.history_size
        last = torch.nn.Linear(hidden, metadata.num_joints)
        torch.nn.init.uniform_(last.weight, -gain, gain)
        torch.nn.init.zeros_(last.bias)
        actor = torch.nn.Sequential(
            *(torch.nn.Linear(widths, hidden), torch.nn.ELU()),
            *(torch.nn.Linear(hidden, hidden), torch.nn.ELU(), last),
        )
        return ExportedPolicy(encoder if estimator else None, actor)

    return make


@pytest.fixture(scope="session")
def exported(make_metadata, make_policy, tmp_path_factory):
    """A random policy that moves the legs a little: torch module, metadata, file."""
    from kiras_rl.export import export_policy

    metadata = make_metadata()
    policy = make_policy(metadata, gain=0.2)
    path = tmp_path_factory.mktemp("policy") / "random.onnx"
    export_policy(policy, metadata, path)
    return policy, metadata, path


@pytest.fixture(scope="session")
def still_file(make_metadata, make_policy, tmp_path_factory):
    """A policy file that always asks for the default pose."""
    from kiras_rl.export import export_policy

    metadata = make_metadata()
    path = tmp_path_factory.mktemp("policy") / "still.onnx"
    export_policy(make_policy(metadata, gain=0.0), metadata, path)
    return path
