"""Text of users in the terminal, and commands that need no graphics."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from patience import patience

from kiras_rl.tools.evaluation.report.content import Column, Table
from kiras_rl.tools.evaluation.report.terminal import as_rich
from kiras_rl.tools.shared.console import make_console


@pytest.mark.parametrize("text", ["M [v2]/[red]x", "[/]", "a:smile:b", "\\[bold]"])
def test_text_is_printed_as_it_is(text, capsys):
    make_console().print(text, soft_wrap=True)
    assert capsys.readouterr().out == f"{text}\n"


def test_names_in_tables_are_printed_as_they_are(capsys):
    table = Table("[red]", (Column("[/x]"), Column("m", best="high")), [("[bold]a", 1.0)])
    make_console().print(as_rich(table))
    out = capsys.readouterr().out
    assert "[red]" in out and "[/x]" in out and "[bold]a" in out


@pytest.mark.slow
def test_a_training_needs_no_graphics(tmp_path):
    code = "import sys; from kiras_rl.tools.commands import train; sys.exit(train(sys.argv[1:]))"
    short = ["--cfg", "smoke", "iterations=1", "finetuning=null", "evaluation.interval=0"]
    done = subprocess.run(
        [sys.executable, "-c", code, *short, "--runs", str(tmp_path)], check=False, text=True,
        env=os.environ | {"MUJOCO_GL": "nonsense"}, capture_output=True, timeout=patience(),
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert list(tmp_path.glob("smoke/*/policy.onnx"))


@pytest.mark.parametrize("name", ["nonsense", "osmesa"])
def test_robots_are_loaded_whatever_graphics_there_are(name):
    code = "from kiras_rl.robots.robot import load_robot; import mujoco; load_robot('solo8')"
    environment = os.environ | {"MUJOCO_GL": name}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True, timeout=patience())
