"""MuJoCo without graphics: only what draws needs an OpenGL, tools/rendering.py."""

from __future__ import annotations

import os
import sys

VARIABLE = "MUJOCO_GL"


def import_mujoco() -> None:
    """Import MuJoCo, whatever OpenGL the environment names.

    MuJoCo loads it at once and fails where it is unknown or missing, even if nothing is drawn.
    """
    try:
        import mujoco
    except (AttributeError, ImportError, RuntimeError):
        chosen = os.environ.pop(VARIABLE, None)
        if chosen is None:
            raise
        for name in [name for name in sys.modules if name.partition(".")[0] in _HALF_DONE]:
            del sys.modules[name]
        try:
            import mujoco  # noqa: F401
        finally:
            os.environ[VARIABLE] = chosen


_HALF_DONE = ("mujoco", "OpenGL")
"""Packages that a failed import leaves behind in parts."""
