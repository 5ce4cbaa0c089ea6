"""What kiras-robot knows of a robot: from the policy file alone, else from robot.yaml."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import fields, replace

import pytest
from rig import shipped

from kiras_rl.deploy.metadata import PolicyError
from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.deploy.profile import Profile
from kiras_rl.deploy.runtime.profiles import profile_of, source_of
from kiras_rl.export import describe_again
from kiras_rl.robots import onboard
from kiras_rl.robots.robot import load_robot
from kiras_rl.tools.export import main


def test_the_loader_and_the_policy_file_know_the_same_numbers():
    assert {field.name for field in fields(Profile)} == set(onboard.KEYS)


@pytest.mark.parametrize("robot", ["solo8", "go1"])
def test_a_robot_s_numbers_come_through_a_policy_file(robot, make_metadata):
    metadata = make_metadata(onboard=load_robot(robot).onboard)
    found = profile_of(type(metadata).from_json(metadata.to_json()))
    expected = load_robot(robot).onboard
    assert vars(found) == {**expected, "late_ticks": tuple(expected["late_ticks"])}
    assert source_of(metadata) == "the policy file"


@pytest.mark.parametrize("robot", ["solo8", "solo8:12A", "go1"])
def test_a_file_of_before_takes_robot_yaml_s_and_says_so(robot, make_metadata):
    metadata = make_metadata(onboard=None, robot=robot)
    assert profile_of(metadata) == Profile.from_dict(load_robot(robot).onboard)
    assert source_of(metadata).startswith(f"robots/{robot[:5].rstrip(':')}/robot.yaml, for")


def test_a_robot_that_is_unknown_is_one_line(make_metadata):
    with pytest.raises(PolicyError, match="there is no robot 'kangaroo'"):
        profile_of(make_metadata(onboard=None, robot="kangaroo"))


def test_a_robot_without_numbers_is_one_line(make_metadata, monkeypatch):
    bare = replace(load_robot("solo8"), onboard=None)
    monkeypatch.setattr("kiras_rl.robots.robot.load_robot", lambda name: bare)
    with pytest.raises(PolicyError, match=r"neither the policy file nor robots/solo8/robot\.yaml"):
        profile_of(make_metadata(onboard=None))


ALONE = """
import sys
for name in ("torch", "mujoco", "yaml", "onnx", "kiras_rl.robots", "kiras_rl.yaml_files"):
    sys.modules[name] = None  # importing it raises ImportError
from kiras_rl.deploy.runtime.command import main
sys.exit(main(["check", sys.argv[1]]))
"""


def check_alone(path) -> subprocess.CompletedProcess:
    """Run kiras-robot check as with the onboard package alone."""
    words = [sys.executable, "-c", ALONE, str(path)]
    return subprocess.run(words, capture_output=True, text=True)


def test_a_policy_file_alone_is_enough(make_metadata, still_file, tmp_path):
    path = tmp_path / "a.onnx"
    metadata = make_metadata(onboard={**load_robot("solo8").onboard, "max_power": 44.0})
    describe_again(still_file, metadata, path)
    done = check_alone(path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "power 44 W" in done.stdout
    assert "numbers      of the policy file" in done.stdout


def test_an_old_file_alone_is_refused_in_one_line(make_metadata, still_file, tmp_path):
    describe_again(still_file, make_metadata(onboard=None), tmp_path / "a.onnx")
    done = check_alone(tmp_path / "a.onnx")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(
        "error: this policy file is older than the numbers of kiras-robot"
    )
    assert done.stderr.count("\n") == 1


def test_an_old_file_is_completed(make_metadata, still_file, tmp_path):
    old, new = tmp_path / "old.onnx", tmp_path / "new.onnx"
    metadata = make_metadata(onboard=None)
    describe_again(still_file, metadata, old)
    assert main([str(old), "--out", str(new)]) == 0
    after = OnboardPolicy(new).metadata
    assert after.onboard == Profile.from_dict(load_robot("solo8").onboard)
    assert replace(after, onboard=None) == metadata
    assert check_alone(new).returncode == 0


@pytest.mark.parametrize("robot", ["solo8", "go1"])
def test_shipped_files_run(robot):
    metadata = OnboardPolicy(shipped(robot)).metadata
    assert profile_of(metadata).rate == load_robot(robot).onboard["rate"]
