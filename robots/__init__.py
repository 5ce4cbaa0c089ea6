"""Robots as data: MJCF, gains, keyframes."""
