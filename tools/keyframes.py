"""Show a robot's keyframes: a table of what each asks of the robot, and one picture of them all.

kiras-keyframes solo8 [--out keyframes.png]
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

from kiras_rl.robots.robot import Keyframe, Robot, load_robot
from kiras_rl.robots.statics import KeyframeReport, examine_keyframe
from kiras_rl.tools.driving.rendering import RenderError, make_renderer
from kiras_rl.tools.shared.arguments import PICTURES, file_of
from kiras_rl.tools.shared.console import make_console
from kiras_rl.tools.shared.ending import finish
from kiras_rl.tools.shared.outputs import check_output, save_figure

WRITER = "kiras-keyframes"

TILE = (420, 340)
"""Width and height of one pose in pixels."""

_ABOUT = "Show a robot's keyframes: a table of what each asks of the robot, and one picture."
_COLUMNS = 5
_DPI = 100
_TITLE = 55
"""Pixels above a tile for its title."""


def main(argv: list[str] | None = None) -> int:
    """Run the command; returns 0, or 2 after an error."""
    parser = argparse.ArgumentParser(prog="kiras-keyframes", description=_ABOUT)
    parser.add_argument("robot", help="a folder of robots/, e.g. solo8")
    parser.add_argument(
        "--out", type=file_of(PICTURES), help="picture (default: runs/keyframes/ROBOT.png)"
    )
    arguments = parser.parse_args(argv)
    return finish(lambda: _show(arguments.robot, arguments.out))


def _show(name: str, out: Path | None) -> int:
    if out:
        check_output(out, WRITER)
    robot = load_robot(name)
    reports = [examine_keyframe(robot, keyframe) for keyframe in robot.keyframes]
    make_console().print(make_table(robot, reports))
    problems = [problem for report in reports if (problem := report.problem())]
    for problem in problems:
        _fail(problem)
    drawn = _save_picture(reports, out)
    return 2 if problems or not drawn else 0


def make_table(robot: Robot, reports: list[KeyframeReport]) -> Table:
    """Return one row a keyframe: pose, reach, torque and feet; what the robot cannot do in red."""
    title = f"{robot.name}: {len(reports)} keyframes"
    table = Table(title=title, title_justify="left", box=None, padding=(0, 2, 0, 0))
    table.add_column("skill", no_wrap=True)
    for heading in ("height\n\n(m)", "pitch\n\n(deg)"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("joint angles\nfrom hip to foot\n(rad)", no_wrap=True)
    for heading in (
        "reach\nmargin\n(mm)",
        "joint\nmargin\n(rad)",
        "static peak\ntorque\n(N m)",
        "foot\nerror\n(mm)",
    ):
        table.add_column(heading, justify="right", no_wrap=True)
    for report in reports:
        table.add_row(*_row(report), style="red" if report.problem() else None)
    return table


def draw(reports: list[KeyframeReport]) -> Figure:
    """Return a figure with a rendered tile a keyframe, all seen from the same distance.

    Raises:
        RenderError: if there is no OpenGL here.
    """
    robot = reports[0].robot
    tiles = _render([report.keyframe for report in reports], robot)
    columns = min(_COLUMNS, len(tiles))
    rows = -(-len(tiles) // columns)
    height = TILE[1] + _TITLE
    figure = Figure(figsize=(columns * TILE[0] / _DPI, rows * height / _DPI), dpi=_DPI)
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    top = 1 - _TITLE / height / rows
    figure.subplots_adjust(0.0, 0.0, 1.0, top, wspace=0.02, hspace=_TITLE / TILE[1])
    for axis in axes:
        axis.axis("off")
    for axis, tile, report in zip(axes, tiles, reports, strict=False):
        axis.imshow(tile)
        axis.set_title(_label(report), fontsize=11)
    return figure


def _row(report: KeyframeReport) -> tuple[str, ...]:
    keyframe = report.keyframe
    return (
        keyframe.name,
        f"{keyframe.base_height:.2f}",
        f"{np.rad2deg(keyframe.pitch):.0f}",
        _angles(report.robot, keyframe),
        f"{1e3 * report.leg_margin:.0f}",
        f"{report.joint_margin.min():.2f}",
        _peak_torque(report),
        f"{1e3 * np.abs(report.foot_height).max():.1f}",
    )


def _peak_torque(report: KeyframeReport) -> str:
    joint = report.worst_joint
    torque, limit = abs(report.torque[joint]), report.robot.torque_limit[joint]
    return f"{torque:.2f} {f'({100 * torque / limit:.0f}%)':>5}"


def _angles(robot: Robot, keyframe: Keyframe) -> str:
    """Write a line for legs that take the same angles; a leg's joints share the name's start."""
    legs: dict[str, list[str]] = {}
    for joint, angle in zip(robot.joint_names, keyframe.joint_pos, strict=True):
        legs.setdefault(joint.split("_")[0], []).append(f"{angle + 0.0:6.2f}")
    alike: dict[str, list[str]] = {}
    for leg, angles in legs.items():
        alike.setdefault("".join(angles), []).append(leg)
    if len(alike) == 1:
        return f"all {next(iter(alike))}"
    return "\n".join(f"{' '.join(names)}{angles}" for angles, names in alike.items())


def _label(report: KeyframeReport) -> str:
    keyframe = report.keyframe
    torque = np.abs(report.torque).max()
    return (
        f"{keyframe.name}: {keyframe.base_height:.2f} m, {np.rad2deg(keyframe.pitch):.0f}°\n"
        f"peak static torque {torque:.2f} N m"
    )


def _render(keyframes: list[Keyframe], robot: Robot) -> list[np.ndarray]:
    """Return a picture a keyframe, each of shape (height, width, 3)."""
    model = robot.spec().compile()
    data = mujoco.MjData(model)
    with make_renderer(model, *TILE) as renderer:
        camera = _camera(model, data, robot)
        tiles = []
        for keyframe in keyframes:
            data.qpos[:] = keyframe.qpos
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            tiles.append(renderer.render().copy())
    return tiles


def _camera(model: mujoco.MjModel, data: mujoco.MjData, robot: Robot) -> mujoco.MjvCamera:
    """Look from the front left, far enough for the robot with its legs stretched."""
    mujoco.mj_resetData(model, data)
    mujoco.mj_forward(model, data)
    parts = model.geom_bodyid > 0
    offset = data.geom_xpos[parts] - data.body(robot.base_body).xpos
    radius = float((np.linalg.norm(offset, axis=1) + model.geom_rbound[parts]).max())
    camera = mujoco.MjvCamera()
    camera.azimuth, camera.elevation = 115.0, -10.0
    camera.distance = 2.5 * radius
    camera.lookat[:] = (0.0, 0.0, 0.45 * max(k.base_height for k in robot.keyframes))
    return camera


def _save_picture(reports: list[KeyframeReport], out: Path | None) -> bool:
    """Draw and save; False where a picture was asked for and there is no OpenGL."""
    path = out or Path("runs", "keyframes", f"{reports[0].robot.name}.png")
    try:
        figure = draw(reports)
    except RenderError as error:
        if out is None:
            print(f"no picture: {error}")
            return True
        _fail(str(error))
        return False
    save_figure(figure, path, WRITER)
    print(f"picture: {path}")
    return True


def _fail(message: str) -> int:
    print(f"error: {message}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
