"""Offscreen pictures: picks an OpenGL backend that works here, or says what to install."""

from __future__ import annotations

import functools
import importlib
import os
import subprocess
import sys

import mujoco
from mujoco.rendering.classic import gl_context

from kiras_rl.deploy.errors import PlainError

BACKENDS = ("egl", "osmesa")
"""Windowless OpenGL on Linux in the order of preference: EGL uses the GPU, OSMesa the CPU."""

_ADVICE = (
    "install libegl1 and libgl1-mesa-dri, or libosmesa6 "
    "(`apt-get install -y libegl1 libgl1-mesa-dri`)"
)

_PROBE = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 16, 16)"
_PROBE_TIMEOUT = 60  # s; a cold driver on a busy machine takes some seconds


class RenderError(PlainError, RuntimeError):
    """No offscreen OpenGL; the text names the system package to install."""


def make_renderer(model: mujoco.MjModel, width: int, height: int) -> mujoco.Renderer:
    """Return a renderer of ``width`` x ``height`` pixels, which the caller closes.

    Grows the model's offscreen buffer to the picture's size where it is smaller.

    Raises:
        RenderError: if no OpenGL backend works here.
    """
    _use_backend(choose_backend())
    buffer = model.vis.global_
    buffer.offwidth = max(buffer.offwidth, width)
    buffer.offheight = max(buffer.offheight, height)
    try:
        return mujoco.Renderer(model, height, width)
    except (RuntimeError, ImportError, AttributeError, mujoco.FatalError) as error:
        raise RenderError(f"offscreen OpenGL failed ({error}): {_ADVICE}") from error


@functools.cache
def choose_backend() -> str:
    """Return the backend to render with: MUJOCO_GL where it is set, else the first that works.

    An empty text stands for the system's own (macOS, Windows).

    Raises:
        RenderError: if none works.
    """
    chosen = os.environ.get("MUJOCO_GL", "").lower().strip()
    candidates = (chosen,) if chosen else BACKENDS
    if not sys.platform.startswith("linux"):
        return chosen
    for backend in candidates:
        if _works(backend):
            return backend
    if chosen:
        raise RenderError(f"no offscreen OpenGL by MUJOCO_GL={chosen}: unset it, or {_ADVICE}")
    raise RenderError(f"no offscreen OpenGL ({' or '.join(candidates)}): {_ADVICE}")


def _works(backend: str) -> bool:
    """Try a backend in a process of its own: PyOpenGL loads one platform a process, for good."""
    environment = {**os.environ, "MUJOCO_GL": backend}
    command = [sys.executable, "-c", _PROBE]
    try:
        probe = subprocess.run(
            command, env=environment, capture_output=True, timeout=_PROBE_TIMEOUT, check=False
        )
    except subprocess.TimeoutExpired:
        return False
    return probe.returncode == 0


def _use_backend(backend: str) -> None:
    """Give mujoco the backend even if it was imported, and so has made its choice, before."""
    if backend not in BACKENDS:
        return  # mujoco's own choice is right
    os.environ["MUJOCO_GL"] = backend
    gl_context.GLContext = importlib.import_module(f"mujoco.{backend}").GLContext
