"""Pictures and videos of a trace."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

import matplotlib
import mujoco
import numpy as np
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont

from kiras_rl.tools.driving.ground import GROUND_GROUP
from kiras_rl.tools.driving.rendering import RenderError, make_renderer
from kiras_rl.tools.driving.script import Trace
from kiras_rl.tools.shared.outputs import check_output, save_figure

STRIPS, VIDEO = "kiras-play --frames", "kiras-play --video"
"""What the files carry as the name of their writer."""

FRAMES = 8  # pictures in a strip
STRIP_SECONDS = 1.0
_FRAME_SIZE = (300, 210)
_DPI = 150
_VIDEO_SIZE = (960, 540)
_VIDEO_RATE = 25
_AZIMUTH, _ELEVATIONS = 110.0, (-12.0, -24.0, -36.0, -48.0, -60.0)  # degrees; the first that sees
_SMOOTH = 0.8  # s over which the camera follows the height of the ground


class Film:
    """Draws configurations of one robot, seen from its right side; the camera goes along.

    Use it in a `with` statement: it holds an OpenGL context.

    Raises:
        RenderError: If this machine cannot render; the message names the system package.
    """

    def __init__(self, model: mujoco.MjModel, size: tuple[int, int], tallest: float) -> None:
        """Open the renderer.

        Args:
            model: The scene.
            size: Width and height of the pictures, pixels.
            tallest: Base height of the tallest posture, m; sets how far the camera stays away.
        """
        self._model, self._data = model, mujoco.MjData(model)
        self._renderer = make_renderer(model, *size)
        self._camera = mujoco.MjvCamera()
        self._camera.azimuth = _AZIMUTH
        self._camera.distance = 3.3 * tallest
        self._middle = 0.5 * tallest

    def __enter__(self) -> Film:
        """Return the film itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Give the OpenGL context back."""
        self._renderer.close()

    def draw(self, qpos: np.ndarray, ground: float = 0.0) -> np.ndarray:
        """Return the picture of a configuration, (height, width, 3) uint8.

        Args:
            qpos: The configuration, (7 + J,).
            ground: Height of the ground under it, m.
        """
        self._data.qpos[:] = qpos
        mujoco.mj_forward(self._model, self._data)
        self._aim(np.array([qpos[0], qpos[1], ground + self._middle]))
        self._renderer.update_scene(self._data, self._camera)
        return self._renderer.render()

    def _aim(self, place: np.ndarray) -> None:
        """Look at a place, (3,), m, from as low as the ground allows."""
        camera, geom = self._camera, np.zeros(1, np.int32)
        camera.lookat[:] = place
        for camera.elevation in _ELEVATIONS:
            way = -_direction(_AZIMUTH, camera.elevation)
            free = mujoco.mj_ray(self._model, self._data, place, way, GROUND_GROUP, 1, -1, geom)
            if not 0 <= free < camera.distance:
                return


def save_strips(trace: Trace, model: mujoco.MjModel, tallest: float, path: Path) -> None:
    """Draw one row of pictures for each skill: the last second of its first segment."""
    rows = [_strip(trace, skill) for skill in dict.fromkeys(trace.skill.tolist())]
    width, height = np.array(_FRAME_SIZE) / _DPI
    size = (FRAMES * (width + 0.02) + 0.4, len(rows) * (height + 0.17))
    figure = Figure(figsize=size)
    figure.set_layout_engine("constrained", w_pad=0.01, h_pad=0.01, wspace=0, hspace=0)
    axes = figure.subplots(len(rows), FRAMES, squeeze=False)
    ground = _ground(trace)
    with Film(model, _FRAME_SIZE, tallest) as film:
        for row, line in zip(rows, axes, strict=True):
            for index, axis in zip(row, line, strict=True):
                axis.imshow(film.draw(trace.qpos[index], ground[index]))
                axis.set_xticks([])
                axis.set_yticks([])
                axis.spines[:].set_visible(False)
                axis.set_xlabel(
                    f"{trace.time[index] - trace.time[row[0]]:.2f} s", fontsize=7, labelpad=2
                )
            line[0].set_ylabel(_label(trace, row[0]), fontsize=9)
    save_figure(figure, path, STRIPS, dpi=_DPI)


def save_video(trace: Trace, model: mujoco.MjModel, tallest: float, path: Path) -> None:
    """Film the whole trace with its skill and command written into the picture.

    Raises:
        RenderError: If the video packages are not installed, or this machine cannot render.
    """
    font = ImageFont.truetype(
        str(Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans-Bold.ttf"), 22
    )
    ground = _ground(trace)
    stride = max(1, round(trace.rate / _VIDEO_RATE))
    with (
        _video_writer(path, trace.rate / stride) as writer,
        Film(model, _VIDEO_SIZE, tallest) as film,
    ):
        for index in range(0, len(trace.time), stride):
            picture = Image.fromarray(film.draw(trace.qpos[index], ground[index]))
            text = _label(trace, index).replace("\n", "   ")
            ImageDraw.Draw(picture).text((24, 20), text, font=font, fill=(20, 30, 40))
            writer.append_data(np.asarray(picture))


def _strip(trace: Trace, skill: int) -> list[int]:
    """Return the samples to draw of a skill, evenly spread."""
    first_segment = trace.segment[trace.skill == skill]
    moving = [s for s in dict.fromkeys(first_segment.tolist()) if _moves(trace, s)]
    chosen = moving[0] if moving else first_segment[0]
    rows = np.flatnonzero(trace.segment == chosen)
    start = max(rows[0], rows[-1] - round(STRIP_SECONDS * trace.rate))
    return np.linspace(start, rows[-1], FRAMES).round().astype(int).tolist()


def _moves(trace: Trace, segment: int) -> bool:
    return bool(np.any(trace.command[trace.segment == segment]))


def _ground(trace: Trace) -> np.ndarray:
    """Return the height of the ground under the robot without its steps, (T,), m."""
    width = 2 * round(_SMOOTH * trace.rate / 2) + 1
    heights = np.pad(trace.qpos[:, 2] - trace.base_height, width // 2, mode="edge")
    return np.convolve(heights, np.full(width, 1 / width), mode="valid")


def _direction(azimuth: float, elevation: float) -> np.ndarray:
    """Return where a camera looks, a unit vector (3,); both angles in degrees, as MuJoCo's."""
    around, up = np.deg2rad([azimuth, elevation])
    return np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])


def _label(trace: Trace, index: int) -> str:
    name = trace.skills[trace.skill[index]].replace("_", " ")
    v_x, v_y, yaw_rate = trace.command[index]
    parts = [f"{v_x:.2f} m/s"]
    parts += [f"{v_y:+.2f} m/s left"] if v_y else []
    parts += [f"{yaw_rate:+.2f} rad/s"] if yaw_rate else []
    return f"{name}\n" + ", ".join(parts)


@contextmanager
def _video_writer(path: Path, rate: float) -> Iterator[Any]:
    try:
        import imageio.v2 as imageio
        import imageio_ffmpeg  # noqa: F401  imageio finds it by itself
    except ImportError:
        raise RenderError("videos need one more package: pip install kiras-rl[video]") from None
    check_output(path, VIDEO)
    about = ["-metadata", f"comment={VIDEO}"]
    writer = imageio.get_writer(path, fps=rate, macro_block_size=1, quality=8, output_params=about)
    try:
        yield writer
    finally:
        writer.close()
