"""kiras-terrains: the picture, the budgets, and what cannot be."""

import numpy as np
import pytest
from matplotlib.image import imread

from kiras_rl.tools import terrains
from kiras_rl.tools.driving import rendering

SMALL = ["finetuning.env.terrain.levels=2", "finetuning.env.terrain.variants=2"]


@pytest.fixture(autouse=True)
def fresh_backend(monkeypatch, tmp_path):
    """Choose the OpenGL backend anew and write to an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("MUJOCO_GL", "")
    rendering.choose_backend.cache_clear()
    yield
    rendering.choose_backend.cache_clear()


def test_the_picture_has_a_tile_for_every_type_and_level(capsys):
    try:
        rendering.choose_backend()
    except rendering.RenderError as error:
        pytest.skip(str(error))
    assert terrains.main(["solo8", "--out", "tiles.png", *SMALL]) == 0
    assert capsys.readouterr().out == "picture: tiles.png\n"
    picture = imread("tiles.png")[..., :3]
    (width, height), (left, top) = terrains.TILE, (150, 40)
    # bars, flat, footholds; slopes twice: up and down
    assert picture.shape == (top + 11 * height, left + 2 * width, 3)
    tiles = picture[top:, left:].reshape(11, height, 2, width, 3).swapaxes(1, 2)
    shades = tiles[:, :, 20:-20, 20:-20].std(axis=(2, 3, 4))
    assert (np.delete(shades, 1) > 0.05).all()  # but for the second flat tile, which is left out
    assert abs(tiles[1:, 0] - tiles[1:, 1]).mean(axis=(1, 2, 3)).min() > 0.01


def test_without_opengl_one_line_names_the_package(monkeypatch, capsys):
    monkeypatch.setenv("MUJOCO_GL", "off")
    assert terrains.main(["solo8", *SMALL]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: no offscreen OpenGL by MUJOCO_GL=off: unset it")
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["solo9"], "there is no robot 'solo9'"),
        (["solo8", "--cfg", "solo8_quick"], "this configuration has no terrain"),
        (
            ["solo8", "finetuning.env.terrain.cell=0.3"],
            "a tile of 8 m has to be a whole number of cells",
        ),
        (["solo8", "finetuning.env.terrain.levls=3"], "env.terrain.levls: Key 'levls' not in"),
    ],
)
def test_what_cannot_be_is_one_line(arguments, message, capsys):
    assert terrains.main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.slow
def test_budgets_suffice(capsys):
    assert terrains.main(["solo8", "--budgets", *SMALL]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    needs = {row[0]: [float(x) for x in row[1:]] for row in rows if len(row) == 4}
    for kind in (
        "flat",
        "slopes",
        "bars",
        "footholds",
        "stairs_up",
        "stairs_down",
        "pits",
        "plates",
        "ramps",
        "rough",
    ):
        contacts, constraints, overflows = needs[kind]
        assert contacts < 32 and constraints < 256 and overflows == 0
