"""The terminal mode in a real terminal: a pseudo one."""

from __future__ import annotations

import os
import pty
import re
import select
import subprocess
import sys
import time

import pytest
from patience import patience

from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.tools.driving.ground import Tile
from kiras_rl.tools.driving.viewer.cockpit import FORWARD, Cockpit
from kiras_rl.tools.driving.viewer.terminal import lines
from kiras_rl.tools.driving.viewer.view import View


@pytest.fixture
def play(still_file):
    """Start the command in a terminal; return what talks to it and the process."""
    master, slave = pty.openpty()
    command = [sys.executable, "-m", "kiras_rl.tools.play", str(still_file), "--terminal"]
    environment = {**os.environ, "TERM": "xterm", "LINES": "40", "COLUMNS": "100"}
    process = subprocess.Popen(
        command, stdin=slave, stdout=slave, stderr=subprocess.PIPE, env=environment, text=True
    )
    os.close(slave)
    yield master, process
    process.kill()
    process.wait()
    process.stderr.close()
    os.close(master)


def read_until(master, pattern):
    seen, end = "", time.monotonic() + patience()
    while not re.search(pattern, seen) and time.monotonic() < end:
        if select.select([master], [], [], 0.1)[0]:
            seen += os.read(master, 65536).decode(errors="replace")
    assert re.search(pattern, seen)


def test_keys_drive_and_x_leaves(play):
    master, process = play
    read_until(master, r"\[1 walk\]")
    os.write(master, b"3")
    read_until(master, r"\x1b\[3[;d]")  # curses sends what changes: here the line of the skills
    os.write(master, b"x")
    assert process.wait(timeout=patience()) == 0
    assert process.stderr.read() == ""


def test_ctrl_c_ends_it_cleanly(play):
    master, process = play
    read_until(master, r"\[1 walk\]")
    process.send_signal(2)
    assert process.wait(timeout=patience()) == 0
    assert process.stderr.read() == ""


def test_the_screen_says_what_is_and_what_is_asked_for(still_file):
    cockpit = Cockpit(OnboardPolicy(still_file), "my policy")
    cockpit.choose_skill("crawl")
    cockpit.set_target(FORWARD, 0.3)
    for _ in range(50):
        cockpit.advance()
    text = "\n".join(lines(cockpit, View()))
    for part in ("my policy", "[2 crawl]", "v_x", "+0.30", "12.0", "estimated v_x", "P push"):
        assert part in text
    assert "terrain flat" in text
    assert "crossed" not in text
    assert "v_y" not in text  # this policy does not move sideways


def test_a_speed_that_cannot_be_changed_is_not_shown(still_file):
    cockpit = Cockpit(OnboardPolicy(still_file))
    cockpit.limits[FORWARD] = 0.3
    assert "v_x" not in lines(cockpit, View())[4]


def test_the_screen_names_the_ground_and_counts_tiles(still_file):
    cockpit = Cockpit(OnboardPolicy(still_file), tile=Tile("stairs_up", 4, 1))
    text = "\n".join(lines(cockpit, View()))
    for part in ("terrain stairs_up:4:1", "crossed 0", "F next terrain"):
        assert part in text
