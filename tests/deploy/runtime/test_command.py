from __future__ import annotations

import os
import subprocess
import sys

import pytest
from campaigns.faults import ENDS, SAYS, try_process
from patience import patience
from rig import shipped

from kiras_rl.dataset import load_dataset
from kiras_rl.deploy.runtime.command import main
from kiras_rl.deploy.runtime.driver import Channel


@pytest.mark.parametrize("robot", ["solo8", "go1"])
def test_check_tells_what_somebody_reads_before_a_leg_moves(robot, capsys):
    assert main(["check", str(shipped(robot))]) == 0
    text = capsys.readouterr().out
    assert f"robot        {robot}" in text
    for word in ("skills", "commands", "first target", "network", "runtime", "driver", "misses"):
        assert word in text
    assert text.rstrip().splitlines()[-1].startswith("fit to run")


def test_gains_that_the_electronics_cannot_carry_are_refused(
    make_metadata, make_policy, tmp_path, capsys
):
    from kiras_rl.export import export_policy

    metadata = make_metadata(kp=[6.0] * 8)
    path = tmp_path / "stiff.onnx"
    export_policy(make_policy(metadata), metadata, path)
    assert main(["check", str(path)]) == 1
    assert "kp is 6 N m/rad, and solo8's electronics carry 5.15" in capsys.readouterr().out
    assert main(["--sim", str(path)]) == 2
    assert "kp is 6 N m/rad" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ([], "nothing was given; it takes --sim"),
        (["fly", "x.onnx"], "fly x.onnx was given"),
        (["--sim", "a", "b"], "--sim takes one policy file"),
        (["check", "none.onnx"], "no policy file at none.onnx"),
        (["go1", "SOLO8"], "is a policy of solo8, not of go1"),
        (["--sim", "SOLO8", "--script", "fly"], "--script: 'fly'"),
    ],
)
def test_what_makes_no_sense_is_one_line(words, complaint, capsys):
    given = [str(shipped("solo8")) if word == "SOLO8" else word for word in words]
    assert main(given) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("error: ")
    assert complaint in printed.err
    assert printed.err.count("\n") == 1


def test_a_second_one_for_the_same_robot_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("KIRAS_ROBOT_SHARED", str(tmp_path))
    channel = Channel("solo8", tmp_path)
    channel.operator.take()
    assert main(["--sim", "--out", str(tmp_path / "out")]) == 2
    assert f"another kiras-robot has the operator (process {os.getpid()}" in capsys.readouterr().err
    channel.operator.leave()


@pytest.mark.slow
def test_a_whole_session_in_real_time_and_its_black_box(tmp_path):
    words = [sys.executable, "-m", "kiras_rl.deploy.runtime.command", "--sim", str(shipped("go1"))]
    words += ["--script", "on,stand,walk:2:0.3,save,lie,quit", "--out", str(tmp_path / "out")]
    done = subprocess.run(
        words,
        env={**os.environ, "KIRAS_ROBOT_SHARED": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=patience(),
    )
    assert "black box:" in done.stdout
    (box,) = (tmp_path / "out").glob("*/blackbox_*")
    states = load_dataset(box)["state"]
    assert states[-1] > 0
    assert done.stderr == ""
    assert done.returncode in (0, 1)  # 1: a machine too busy for the deadlines, which it then names
    assert done.returncode == 0 or "damped by" in done.stdout
    assert "misses" in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(("role", "end"), list(SAYS))
def test_a_process_that_ends_or_stops_is_named(role, end, tmp_path):
    assert end in ENDS
    assert SAYS[role, end] in try_process(role, end, tmp_path)
