"""kiras-keyframes: the table, the picture, and what happens without OpenGL."""

import pytest

from kiras_rl.robots.robot import load_robot
from kiras_rl.robots.statics import examine_keyframe
from kiras_rl.tools import keyframes, terrains
from kiras_rl.tools.driving import rendering


@pytest.fixture(autouse=True)
def fresh_backend(monkeypatch, tmp_path):
    """Choose the OpenGL backend anew and write to an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("MUJOCO_GL", "")
    rendering.choose_backend.cache_clear()
    yield
    rendering.choose_backend.cache_clear()


@pytest.fixture
def no_opengl(monkeypatch):
    """Leave mujoco a machine without OpenGL."""
    monkeypatch.setenv("MUJOCO_GL", "off")


@pytest.fixture
def opengl():
    try:
        rendering.choose_backend()
    except rendering.RenderError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("command", [keyframes.main, terrains.main])
def test_a_picture_that_cannot_be_written_is_refused(command, opengl, tmp_path, capsys):
    with pytest.raises(SystemExit) as caught:
        command(["solo8", "--out", "a.txt"])
    assert caught.value.code == 2
    assert "'a.txt' does not end in .png" in capsys.readouterr().err
    (tmp_path / "file").touch()
    assert command(["solo8", "--out", "file/a.png"]) == 2
    assert capsys.readouterr().err.startswith("error: ")


def test_table_says_what_each_keyframe_asks(no_opengl, capsys):
    assert keyframes.main(["solo8"]) == 0
    rows = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    # height, pitch, hip and knee, 0.32 - 0.284 m of reach, 1.45 - 0.48 rad to the hip's limit,
    # 0.38 of 1.8 N m, feet on the ground
    assert "stilt 0.30 0 FL FR 0.48 -0.96 36 0.97 0.38 (21%) 0.0" in rows
    assert "pitch_up 0.20 -15 FL FR 1.02 -1.51 87 0.43 0.73 (40%) 0.0" in rows
    assert "HL HR -0.87 2.27" in rows


def test_without_opengl_one_line_names_the_package(no_opengl, capsys):
    assert keyframes.main(["go1"]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("no picture: ")
    assert "apt-get install -y libegl1" in last


def test_a_picture_that_was_asked_for_is_an_error_without_opengl(no_opengl, capsys):
    assert keyframes.main(["solo8", "--out", "poses.png"]) == 2
    captured = capsys.readouterr()
    assert "stilt" in captured.out
    assert captured.err.startswith("error: no offscreen OpenGL by MUJOCO_GL=off: unset it")
    assert captured.err.count("\n") == 1


def test_unknown_robot_is_one_line(capsys):
    assert keyframes.main(["solo9"]) == 2
    assert capsys.readouterr().err.startswith("error: there is no robot 'solo9' (did you mean")


def test_picture_shows_all_poses(opengl):
    robot = load_robot("solo8")
    figure = keyframes.draw([examine_keyframe(robot, keyframe) for keyframe in robot.keyframes])
    tiles = [axis.images[0].get_array() for axis in figure.axes]
    titles = [axis.get_title().split(":")[0] for axis in figure.axes]
    assert titles == list(robot.skills)
    for tile in tiles:
        assert tile.shape == (keyframes.TILE[1], keyframes.TILE[0], 3)
        assert tile.std() > 10  # not an empty picture
    assert abs(tiles[1].astype(float) - tiles[2]).mean() > 2  # crawl is not stilt


def test_picture_is_written(opengl, tmp_path, capsys):
    assert keyframes.main(["go1"]) == 0
    assert (tmp_path / "runs" / "keyframes" / "go1.png").read_bytes().startswith(b"\x89PNG")
    assert "picture: runs/keyframes/go1.png" in capsys.readouterr().out


def test_large_pictures_grow_the_offscreen_buffer(opengl):
    model = load_robot("solo8").spec().compile()
    model.vis.global_.offwidth = 320
    with rendering.make_renderer(model, 640, 200) as renderer:
        assert renderer.render().shape == (200, 640, 3)
