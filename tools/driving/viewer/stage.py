"""What is looked at: the driven scene, and the keyframe of the chosen skill as a ghost in it."""

from __future__ import annotations

import mujoco
import numpy as np

from kiras_rl.deploy.metadata import Posture
from kiras_rl.tools.driving.driver import Driver

GHOST_GROUP = 1
"""Geom group of the ghost; 0 is the floor, 2 the robot's visuals, 3 its collision shapes."""

_PREFIX = "ghost_"
_COLOUR = (0.20, 0.62, 0.95, 0.30)
_COLLISION_GROUP = 3
_SUN, _GROUND = 3.0, 0.62  # times the light and the colours of the scene
_SKY = 64  # pixels
_SHADOWS = 256  # pixels
_EFFECTS = ("filament.ao.enabled", "filament.bloom.enabled")  # as the page's renderer calls them


class Stage:
    """A copy of the driver's scene with a second robot, which is posed and never simulated.

    The driver's own model knows nothing of it, so that the physics is the same with and without.

    Attributes:
        driver: Whose scene this is.
        model: The scene with the ghost.
        data: Its state.
    """

    def __init__(self, driver: Driver, plain: bool = False) -> None:
        """Copy the scene, with its names and looks, and add the ghost.

        Args:
            driver: Whose scene.
            plain: Whether to leave out what makes pictures slow.
        """
        self.driver, self._plain = driver, plain
        spec = driver.spec.copy()
        spec.worldbody.add_frame().attach_body(_ghost(driver), _PREFIX, "")
        _dress(spec)
        if plain:
            _simplify(spec)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._own, self._scene = driver.model.nq, driver.scene

    def move_to(self, driver: Driver, plain: bool = False) -> Stage:
        """Return the stage of a driver as it is now: this one if all that is seen is the same."""
        if (driver.scene, plain) != (self._scene, self._plain):
            return Stage(driver, plain)
        self.driver = driver
        return self

    def pose(self, side: float = 0.0) -> None:
        """Show the driver's robot as it is, and the ghost at its place in the posture asked for.

        Args:
            side: How far to the left of the robot the ghost stands, m.
        """
        qpos = self.driver.data.qpos
        self.data.time = self.driver.data.time
        self.data.qpos[: self._own] = qpos
        ghost = ghost_pose(qpos, self.driver.posture, side)
        ghost[2] += self.driver.ground_height(ghost[:2])
        self.data.qpos[self._own :] = ghost


def ghost_pose(qpos: np.ndarray, posture: Posture, side: float = 0.0) -> np.ndarray:
    """Return the configuration of a keyframe at a robot's place and heading, (7 + J,).

    It stands on flat ground.

    Args:
        qpos: Configuration of the robot, (7 + J,).
        posture: The keyframe.
        side: How far to the left of the robot, m.
    """
    w, x, y, z = qpos[3:7]
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    heading = np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
    tilt = np.array([np.cos(posture.pitch / 2), 0.0, np.sin(posture.pitch / 2), 0.0])
    quat = np.zeros(4)
    mujoco.mju_mulQuat(quat, heading, tilt)
    place = (qpos[0] - side * np.sin(yaw), qpos[1] + side * np.cos(yaw), posture.base_height)
    return np.concatenate([place, quat, posture.joint_pos])


def _dress(spec: mujoco.MjSpec) -> None:
    """Suit the scene to the page, whose renderer brings soft light of its own.

    A strong sun on a darker ground gives the robot its shadow. The sky's gradient needs few pixels,
    and a browser waits for every one of them.
    """
    spec.visual.headlight.ambient[:] = 0.08
    spec.visual.headlight.diffuse[:] = 0.06
    sun, *others = spec.lights
    sun.diffuse = _SUN * sun.diffuse
    for light in others:
        light.castshadow = False
    ground, sky = spec.texture("floor"), spec.texture("sky")
    for colour in ("rgb1", "rgb2", "markrgb"):
        setattr(ground, colour, _GROUND * getattr(ground, colour))
    sky.width, sky.height = _SKY, 6 * _SKY


def _simplify(spec: mujoco.MjSpec) -> None:
    """Leave out what takes a renderer on a CPU most of its time."""
    for light in spec.lights:
        light.castshadow = False
    spec.visual.quality.shadowsize = _SHADOWS  # a map is drawn all the same
    spec.visual.quality.offsamples = 0
    for effect in _EFFECTS:
        spec.add_numeric(name=effect, data=[0], size=1)


def _ghost(driver: Driver) -> mujoco.MjsBody:
    """Return the robot's body with its visuals alone, translucent."""
    spec = driver.robot.spec()
    for geom in list(spec.geoms):
        if geom.group == _COLLISION_GROUP:
            spec.delete(geom)
            continue
        geom.material, geom.rgba, geom.group = "", _COLOUR, GHOST_GROUP
    for element in [*spec.actuators, *spec.materials, *spec.textures]:
        spec.delete(element)
    return spec.body(driver.robot.base_body)
