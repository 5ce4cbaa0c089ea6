"""Show a robot's terrain: one picture of all types and levels, and what physics needs on each.

kiras-terrains solo8 [--cfg base] [--out terrains.png] [--budgets] [key=value ...]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import mujoco
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.table import Table

from kiras_rl.config import ConfigError, load_config
from kiras_rl.envs.model import build_scene
from kiras_rl.envs.terrain_library import TerrainLibrary, build_library
from kiras_rl.phases import plan
from kiras_rl.robots.robot import Robot, load_robot
from kiras_rl.schema import Config
from kiras_rl.tools.benchmarks.terrain_budgets import measure_budgets
from kiras_rl.tools.driving.rendering import make_renderer
from kiras_rl.tools.shared.arguments import PICTURES, file_of
from kiras_rl.tools.shared.console import make_console
from kiras_rl.tools.shared.ending import finish
from kiras_rl.tools.shared.outputs import check_output, save_figure

WRITER = "kiras-terrains"

TILE = (300, 200)
"""Width and height of one tile in pixels."""

_SUN = (0.75, -0.35, -0.56)
"""Direction of the light: flat enough that bumps throw shadows."""

_ABOUT = "Show a robot's terrain: one picture of all types and levels."
_DPI = 100
_MARGIN = (150, 40)
"""Pixels left of the tiles for the types, and above them for the levels."""


def main(argv: list[str] | None = None) -> int:
    """Run the command; returns 0, or 2 after an error."""
    parser = argparse.ArgumentParser(prog="kiras-terrains", description=_ABOUT)
    parser.add_argument("robot", help="a folder of robots/, e.g. solo8")
    parser.add_argument("--cfg", default="base", help="configuration with the terrain")
    parser.add_argument(
        "--out", type=file_of(PICTURES), help="picture (default: runs/terrains/ROBOT.png)"
    )
    parser.add_argument("--budgets", action="store_true", help="measure contacts on MuJoCo-Warp")
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="of the configuration")
    arguments = parser.parse_intermixed_args(argv)  # options between overrides, too
    return finish(lambda: _show(arguments))


def _show(arguments: argparse.Namespace) -> None:
    if arguments.out:
        check_output(arguments.out, WRITER)
    whole = load_config(arguments.cfg, [f"robot={arguments.robot}", *arguments.overrides])
    config = plan(whole)[-1].config
    robot = load_robot(config.robot)
    library = _library(config)
    path = arguments.out or Path("runs", "terrains", f"{robot.name}.png")
    if arguments.budgets:
        make_console().print(make_table(config, robot, library))
        return
    save_figure(draw(robot, library), path, WRITER)
    print(f"picture: {path}")


def make_table(config: Config, robot: Robot, library: TerrainLibrary) -> Table:
    """Return one row a type: the most that physics took of each budget at the top level."""
    sim = config.sim
    title = f"{robot.name} in random motions and falls at the top level, MuJoCo-Warp"
    table = Table(title=title, title_justify="left", box=None, padding=(0, 2, 0, 0))
    table.add_column("type", no_wrap=True)
    for key in ("max_contacts", "max_constraints"):
        table.add_column(f"sim.{key}\n(now {getattr(sim, key)})", justify="right", no_wrap=True)
    table.add_column(f"overflows\n(sim.max_ccd {sim.max_ccd})", justify="right", no_wrap=True)
    for name, need in measure_budgets(sim, robot, library).items():
        row = (f"{need['max_contacts']:.1f}", f"{need['max_constraints']:.0f}")
        table.add_row(
            name, *row, f"{need['overflowed']:.0f}", style="red" if need["overflowed"] else None
        )
    return table


def draw(robot: Robot, library: TerrainLibrary) -> Figure:
    """Return a figure with a rendered tile for every type (rows) and level (columns).

    A type that leads up in one variant and down in the next has two rows; of one that has no
    obstacles a single tile is drawn.

    Raises:
        RenderError: if there is no OpenGL here.
    """
    rows = _rows(library)
    pictures = _render(robot, library, {tile for _, tiles in rows for tile in tiles if tile >= 0})
    tiles = [[pictures.get(tile) for tile in tiles] for _, tiles in rows]
    width = _MARGIN[0] + library.levels * TILE[0]
    height = _MARGIN[1] + len(rows) * TILE[1]
    figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI, facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(rows), library.levels, squeeze=False)
    figure.subplots_adjust(
        _MARGIN[0] / width, 0.0, 1.0, 1 - _MARGIN[1] / height, wspace=0.015, hspace=0.02
    )
    for row, pictures in zip(axes, tiles, strict=True):
        _fill(row, pictures)
    for level in range(library.levels):
        axes[0, level].set_title(f"level {level}", fontsize=12, pad=8)
    for axis, (label, _) in zip(axes[:, 0], rows, strict=True):
        axis.text(-0.06, 0.5, label, transform=axis.transAxes, ha="right", va="center", fontsize=12)
    return figure


def _fill(axes: np.ndarray, pictures: list[np.ndarray | None]) -> None:
    for axis, picture in zip(axes, pictures, strict=True):
        axis.axis("off")
        if picture is not None:
            axis.imshow(picture, aspect="auto")
    if pictures[-1] is None:
        axes[1].text(0.06, 0.5, "the same at every level", va="center", fontsize=12, color="0.5")


def _library(config: Config) -> TerrainLibrary:
    if config.env.terrain is None:
        raise ConfigError(
            "this configuration has no terrain: neither finetuning nor env.terrain; try --cfg base"
        )
    return build_library(config.env.terrain)


def _rows(library: TerrainLibrary) -> list[tuple[str, list[int]]]:
    """Return the label and the tiles of each row; -1 for none."""
    levels, rows = np.arange(library.levels), []
    for kind, name in enumerate(library.types):
        first, second = (
            library.index(kind, levels, variant) for variant in (0, library.variants > 1)
        )
        heights = library.spawn_height[first], library.spawn_height[second]
        alike = (library.grid[first] == 0).all() and not np.ptp(library.tops[first])
        rows.append((name, np.where(alike & (levels > 0), -1, first).tolist()))
        if not np.allclose(*heights, atol=0.01):
            rows.append((f"{name},\nfrom the top", second.tolist()))
    return rows


def _render(robot: Robot, library: TerrainLibrary, tiles: set[int]) -> dict[int, np.ndarray]:
    """Return a picture of each tile, of shape (height, width, 3)."""
    scene = build_scene(robot, 0.005, 10, library=library, visuals=True)
    model, pictures, ground = scene.model, {}, scene.terrain
    assert ground is not None
    model.stat.extent = 3.0  # m: shadows and clipping planes reach as far as the picture
    model.light("sun").dir[:] = _SUN
    model.light("sun").diffuse[:] = 0.85
    data = mujoco.MjData(model)
    with make_renderer(model, *TILE) as renderer:
        for tile in tiles:
            ground.show(model, data, tile)
            data.qpos[:] = robot.keyframes[0].qpos
            data.qpos[2] += library.spawn_height[tile]
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, _camera(library.spawn_height[tile]))
            pictures[tile] = renderer.render().copy()
    return pictures


def _camera(lookat_height: float) -> mujoco.MjvCamera:
    camera = mujoco.MjvCamera()
    camera.azimuth, camera.elevation = 115.0, -28.0
    camera.distance = 5.0
    camera.lookat[:] = (0.0, 0.0, lookat_height)
    return camera


if __name__ == "__main__":
    sys.exit(main())
