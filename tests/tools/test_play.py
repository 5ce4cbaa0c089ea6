"""kiras-play: the page, a table, a picture, and one line for everything that cannot be."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
import urllib.request

import matplotlib.image
import numpy as np
import pytest
from patience import patience

from kiras_rl.robots.robot import load_robot
from kiras_rl.tools.driving import rendering
from kiras_rl.tools.play import main
from kiras_rl.tools.shared import policy_files

SHORT = "--script=walk:0.4:0.3,crawl:0.4:0.3"


def test_the_page_is_served_until_ctrl_c(still_file):
    command = [sys.executable, "-m", "kiras_rl.tools.play", still_file, "--port=0", "--no-browser"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **pipes) as process:
        try:
            line = process.stdout.readline()
            assert "driving still.onnx: http://127.0.0.1:" in line
            assert "this machine only" in line
            url = re.search(r"http://\S+/", line)[0]
            assert b"<canvas" in urllib.request.urlopen(url, timeout=patience()).read()
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=patience())
        finally:
            process.kill()
    assert (process.returncode, out.strip(), err) == (0, "", "")


def test_a_table_of_every_skill_is_printed(still_file, capsys):
    assert main([str(still_file), "--table"]) == 0
    out = capsys.readouterr().out
    assert "solo8, 21 s" in out
    for skill in load_robot("solo8").skills:
        assert skill in out


def test_a_script_is_driven_on_terrain(still_file, tmp_path, capsys):
    path = tmp_path / "trace.npz"
    arguments = [
        str(still_file),
        SHORT,
        "--terrain",
        "stairs_down:4:1",
        "--table",
        "--trace",
        str(path),
    ]
    assert main(arguments) == 0
    out = capsys.readouterr().out
    assert "solo8 on stairs_down:4:1, 0.8 s" in out
    assert "crossed" in out
    trace = np.load(path)
    assert trace["qpos"][0, 2] > trace["base_height"][0] + 0.5  # on a platform of eleven steps


def test_a_trace_is_drawn(still_file, tmp_path, capsys):
    path = tmp_path / "new" / "trace.png"
    assert main([str(still_file), SHORT, "--trace", str(path)]) == 0
    picture = matplotlib.image.imread(path)[:, :, :3]
    assert min(picture.shape[:2]) > 600
    for part in np.array_split(picture, 5):  # about one panel each
        assert len(np.unique(part.reshape(-1, 3), axis=0)) > 20
    assert capsys.readouterr().out == f"wrote {path}\n"


def test_a_trace_is_saved_as_arrays(still_file, tmp_path):
    assert main([str(still_file), SHORT, "--trace", str(tmp_path / "trace.npz")]) == 0
    assert np.load(tmp_path / "trace.npz")["base_height"].shape == (40,)


def test_a_strip_of_pictures_is_drawn(still_file, tmp_path):
    try:
        rendering.choose_backend()
    except rendering.RenderError as error:
        pytest.skip(str(error))
    path = tmp_path / "strip.png"
    assert main([str(still_file), "--script=walk:0.1:0.3", "--frames", str(path)]) == 0
    picture = matplotlib.image.imread(path)
    assert picture.shape[1] > 8 * 290  # eight pictures of 300 pixels in one row
    assert picture[:, :, :3].std() > 0.05


def test_the_policy_that_comes_with_a_robot_is_taken(monkeypatch, still_file, tmp_path, capsys):
    monkeypatch.setattr(policy_files, "shipped_policy", lambda robot: still_file)
    assert main([SHORT]) == 0  # a script that nothing is to be made of ends in the table
    assert "solo8, 0.8 s" in capsys.readouterr().out


def test_of_a_run_the_exported_policy_comes_first(tmp_path):
    (tmp_path / "checkpoints").mkdir()
    for name in ("checkpoints/latest.pt", "checkpoints/best.pt", "policy.onnx"):
        (tmp_path / name).touch()
        assert policy_files.find_policy(tmp_path) == tmp_path / name
    assert policy_files.find_checkpoint(tmp_path) == tmp_path / "checkpoints/best.pt"


def test_help_reads_like_a_manual(capsys):
    with pytest.raises(SystemExit) as leaving:
        main(["--help"])
    assert leaving.value.code == 0
    out = capsys.readouterr().out
    words = (
        "examples:",
        "--follow",
        "--terminal",
        "--trace",
        "--script",
        "--terrain",
        "RUN",
        "CHECKPOINT",
    )
    for word in (*words, "kiras-play --frames"):
        assert word in out


@pytest.fixture
def error_of(capsys):
    """Run the command, and return the one line that it says on stderr."""

    def run(*arguments):
        assert main([str(argument) for argument in arguments]) == 2
        captured = capsys.readouterr()
        assert captured.err.startswith("error: ")
        assert captured.err.count("\n") == 1
        return captured.err

    return run


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--script", "fly:4:0.3"], "unknown skill 'fly' in the script; this policy has: walk,"),
        (["--script", "walk"], "a script's part is skill:seconds:v_x"),
        (["--command", "fast"], "a command is v_x[,v_y[,yaw_rate]], e.g. 0.3"),
        (
            ["--terrain", "ice"],
            "no terrain 'ice'; there are: flat, slopes, bars, footholds, stairs",
        ),
        (["--terrain", "stairs_up:12", "--table"], "no terrain level 12; it goes from 0 to 9"),
        (["--robot", "go1"], "--robot go1 was given, but"),
        (["--follow"], "only a run can be followed, such as runs/solo8/<time>, not "),
        (["--host", "999.1.1.1"], "cannot listen on --host 999.1.1.1"),
        (["--port", "99999"], "--port is a number from 0 to 65535, not 99999"),
    ],
)
def test_a_bad_request_is_one_line(error_of, still_file, arguments, message):
    assert message in error_of(still_file, *arguments)


def test_a_missing_file_is_one_line(error_of, tmp_path):
    assert "there is no file or folder" in error_of(tmp_path / "gone.onnx")


def test_following_nothing_is_one_line(error_of):
    assert "--follow needs a run" in error_of("--follow")


def test_a_port_that_is_taken_is_one_line(error_of, still_file):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert f"port {port} is taken" in error_of(still_file, "--port", port)


def test_driving_with_keys_needs_a_terminal(error_of, still_file):
    assert "--terminal needs a terminal" in error_of(still_file, "--terminal")


def test_a_picture_of_the_page_needs_a_browser(monkeypatch, error_of, still_file, tmp_path):
    monkeypatch.setenv("PATH", "")
    message = error_of(still_file, "--screenshot", tmp_path / "page.jpg")
    assert "none of chromium, chromium-browser, google-chrome" in message


def test_a_foreign_file_is_one_line(error_of, tmp_path):
    (tmp_path / "a.onnx").write_text("a letter")
    assert "is not an ONNX file that can be run" in error_of(tmp_path / "a.onnx")
    (tmp_path / "a.txt").write_text("a letter")
    assert "is none of: run folder, .onnx, .pt" in error_of(tmp_path / "a.txt")


def test_a_run_without_checkpoints_is_one_line(error_of, tmp_path):
    (tmp_path / "config.yaml").touch()
    message = error_of(tmp_path)
    assert "holds none of policy.onnx, checkpoints/best.pt, checkpoints/latest.pt" in message


def test_a_folder_of_runs_names_them(error_of, tmp_path):
    for name in ("monday", "tuesday"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.yaml").touch()
    assert "it holds the runs monday, tuesday: name one of them" in error_of(tmp_path)


def test_an_unknown_robot_is_one_line(error_of):
    assert "there is no robot 'solo9'" in error_of("--robot", "solo9")


def test_a_wrong_ending_is_named_with_those_that_work(still_file, capsys):
    with pytest.raises(SystemExit) as leaving:
        main([str(still_file), "--video", "film.gif"])
    assert leaving.value.code == 2
    assert "'film.gif' does not end in .mp4" in capsys.readouterr().err


def test_a_missing_video_package_is_one_line(monkeypatch, error_of, still_file, tmp_path):
    monkeypatch.setitem(sys.modules, "imageio.v2", None)
    message = error_of(still_file, SHORT, "--video", tmp_path / "film.mp4")
    assert "pip install kiras-rl[video]" in message


def test_a_machine_without_opengl_is_one_line(monkeypatch, error_of, still_file, tmp_path):
    monkeypatch.setenv("MUJOCO_GL", "nothing")
    rendering.choose_backend.cache_clear()
    message = error_of(still_file, SHORT, "--frames", tmp_path / "strip.png")
    rendering.choose_backend.cache_clear()
    assert "apt-get install" in message
