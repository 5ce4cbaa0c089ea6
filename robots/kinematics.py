"""Geometry of the legs, read from the compiled MJCF, and their inverse kinematics."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

KNEES = ("back", "forward", "inward")
"""Where knees may point; inward: the front ones back, the hind ones forward."""

_TOUCHING = 1e-6
"""m; a leg this much too short or long is a rounding error."""


class LegError(ValueError):
    """A leg that the inverse kinematics here does not know."""


class ReachError(ValueError):
    """A foot position that no joint angles reach."""


@dataclass(frozen=True, eq=False)
class Leg:
    """A planar two-link leg: the last two hinge joints (about y) above a foot."""

    hip_joint: int
    """Index of the hip joint among the robot's joints."""
    knee_joint: int
    """Index of the knee joint among the robot's joints."""
    hip: np.ndarray
    """Hip position in the base frame, zero pose. Shape (3,), m."""
    thigh: np.ndarray
    """Hip to knee in the zero pose, (x, z). Shape (2,), m."""
    shank: np.ndarray
    """Knee to the foot's centre in the zero pose, (x, z). Shape (2,), m."""

    @property
    def lengths(self) -> tuple[float, float]:
        """Lengths of thigh and shank in m."""
        return float(np.hypot(*self.thigh)), float(np.hypot(*self.shank))

    @property
    def reach(self) -> tuple[float, float]:
        """Shortest and longest distance from hip to foot centre in m."""
        thigh, shank = self.lengths
        return abs(thigh - shank), thigh + shank

    def hip_height(self, base_height: float, pitch: float) -> float:
        """Return the hip's height (m) over the ground at a base height (m) and pitch (rad)."""
        return base_height - self.hip[0] * np.sin(pitch) + self.hip[2] * np.cos(pitch)

    def reach_foot(
        self, below: float, ahead: float, pitch: float, knee_back: bool
    ) -> tuple[float, float]:
        """Return the hip and knee angles that put the foot's centre where it is asked for, rad.

        The triangle hip, knee, foot gives each link's angle from the line between hip and foot
        (law of cosines); base pitch and the links' own angles in the zero pose are taken off.

        Args:
            below: Height of the hip above the foot's centre, m.
            ahead: Distance of the foot's centre ahead of the hip, level, m.
            pitch: Of the base, nose down positive, rad.
            knee_back: Whether the knee lies behind that line, or else ahead of it.

        Raises:
            ReachError: if the triangle does not close.
        """
        length = leg_length(below, ahead)
        a, b = self.lengths
        shortest, longest = self.reach
        if not max(shortest, _TOUCHING) <= length <= longest + _TOUCHING:
            raise ReachError(f"{length:.3f} m is outside {shortest:.3f} to {longest:.3f} m")
        length = min(length, longest)
        side = 1.0 if knee_back else -1.0
        line = -np.arctan2(ahead, below)  # from the vertical, backward positive
        thigh = line + side * np.arccos(
            np.clip((length**2 + a**2 - b**2) / (2 * length * a), -1, 1)
        )
        shank = line - side * np.arccos(
            np.clip((length**2 + b**2 - a**2) / (2 * length * b), -1, 1)
        )
        hip_angle = thigh - pitch - _from_vertical(self.thigh)
        return hip_angle, shank - _from_vertical(self.shank) - pitch - hip_angle


def leg_length(below: float, ahead: float) -> float:
    """Return the distance from hip to foot in m, negative for a foot above its hip."""
    return float(np.copysign(np.hypot(below, ahead), below))


def find_legs(model: mujoco.MjModel, base: str, feet: tuple[str, ...]) -> tuple[Leg, ...]:
    """Measure the leg above each foot geom with all joints at zero."""
    data = mujoco.MjData(model)
    data.qpos[:7] = (0, 0, 0, 1, 0, 0, 0)
    data.qpos[7:] = 0
    mujoco.mj_kinematics(model, data)
    return tuple(_find_leg(model, data, model.body(base).id, model.geom(foot).id) for foot in feet)


def _find_leg(model: mujoco.MjModel, data: mujoco.MjData, base: int, foot: int) -> Leg:
    knee = model.body_jntadr[model.geom_bodyid[foot]]
    hip = model.body_jntadr[model.body_parentid[model.geom_bodyid[foot]]]
    for joint in (hip, knee):
        if joint < 0 or not np.allclose(data.xaxis[joint], (0, 1, 0)):
            foot_name = model.geom(foot).name
            raise LegError(
                f"foot {foot_name!r} has no leg of two hinges about +y above it, which inverse "
                f"kinematics needs: give joint_pos in place of knees"
            )
    knee_at, foot_at = data.xanchor[knee], data.geom_xpos[foot]
    hip_at = data.xanchor[hip]
    return Leg(
        hip_joint=int(model.jnt_qposadr[hip]) - 7,
        knee_joint=int(model.jnt_qposadr[knee]) - 7,
        hip=hip_at - data.xpos[base],
        thigh=(knee_at - hip_at)[[0, 2]],
        shank=(foot_at - knee_at)[[0, 2]],
    )


def _from_vertical(link: np.ndarray) -> float:
    """Return the angle about +y that turns straight down into ``link`` (x, z)."""
    return float(np.arctan2(-link[0], -link[1]))
