"""Robots as data: MJCF, gains, keyframes."""

from kiras_rl.graphics import import_mujoco

import_mujoco()
