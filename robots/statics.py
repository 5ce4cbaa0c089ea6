"""Can a robot stand still in a keyframe: where its feet are, and which torques hold it there."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from kiras_rl.robots.keyframes import Keyframe
from kiras_rl.robots.kinematics import Leg, LegError, find_legs
from kiras_rl.robots.robot import Robot, RobotError

FOOT_TOLERANCE = 0.005
"""m; a foot within this distance of the ground counts as standing on it."""

LIMB_CLEARANCE = 0.005
"""m; only feet stand on the ground: thighs, shanks and base are at least this far above it."""

JOINT_MARGIN = 0.1
"""rad; a keyframe stays at least this far from joint limits: its steps need room, too."""

TORQUE_MARGIN = 0.2
"""Share of the torque limit that holding a keyframe leaves."""

BALANCE_TOLERANCE = 0.01
"""m; how far the centre of mass may lie outside the feet that stand."""

_WEIGHTS = np.array([100.0] * 3 + [1.0] * 3)
"""Forces on the base balance first, then moments: what is left over is a moment."""


@dataclass(frozen=True, eq=False)
class KeyframeReport:
    """What holding a keyframe takes."""

    robot: Robot
    keyframe: Keyframe
    leg_margin: float
    """Full leg length minus the longest hip-to-foot distance in m; nan without two-link legs."""
    foot_height: np.ndarray
    """Height of each foot's lowest point above the ground. Shape (F,), m."""
    limb_height: dict[str, float]
    """Height of each limb's and the base's lowest point above the ground, by geom, in m."""
    torque: np.ndarray
    """Joint torques that hold the pose. Shape (J,), N m."""
    imbalance: float
    """Distance of the centre of mass from where the feet could carry it in m."""

    @property
    def joint_margin(self) -> np.ndarray:
        """Distance of each joint from the nearer of its limits. Shape (J,), rad."""
        low, high = self.robot.joint_limits.T
        return np.minimum(self.keyframe.joint_pos - low, high - self.keyframe.joint_pos)

    @property
    def worst_joint(self) -> int:
        """Index of the joint that uses the largest part of its torque limit."""
        return int(np.argmax(np.abs(self.torque) / self.robot.torque_limit))

    def problem(self) -> str | None:
        """Return why the robot cannot stand in this keyframe, or None."""
        place = f"keyframe {self.keyframe.name!r} of {self.robot.name}"
        path = self.robot.folder / "keyframes.yaml"
        lowest = float(self.foot_height.min())
        if abs(lowest) > FOOT_TOLERANCE:
            side, verb = ("above", "lower") if lowest > 0 else ("below", "raise")
            return (
                f"{place}: the lowest foot is {abs(lowest):.3f} m {side} the ground: "
                f"{verb} base_height by {abs(lowest):.3f} m in {path}"
            )
        limb = min(self.limb_height, key=self.limb_height.__getitem__)
        if self.limb_height[limb] < LIMB_CLEARANCE:
            return (
                f"{place}: {limb} is {self.limb_height[limb]:.3f} m above the ground, "
                f"{LIMB_CLEARANCE:g} m at least: change "
                f"feet_ahead, base_height or joint_pos in {path}"
            )
        if self.imbalance > BALANCE_TOLERANCE:
            return (
                f"{place}: the robot tips over, its centre of mass lies {self.imbalance:.3f} m "
                f"outside its feet: change joint_pos or pitch in {path}"
            )
        joint = self.worst_joint
        torque, limit = abs(self.torque[joint]), self.robot.torque_limit[joint]
        allowed = (1.0 - TORQUE_MARGIN) * limit
        if torque > allowed:
            return (
                f"{place}: {self.robot.joint_names[joint]} needs {torque:.2f} N m to hold it, "
                f"{allowed:.2f} N m at most ({TORQUE_MARGIN:.0%} below its limit): "
                f"change the pose in {path}"
            )
        nearest = int(np.argmin(self.joint_margin))
        if self.joint_margin[nearest] < JOINT_MARGIN:
            return (
                f"{place}: {self.robot.joint_names[nearest]} is "
                f"{self.joint_margin[nearest]:.3f} rad from its limit, {JOINT_MARGIN:g} rad at "
                f"least: move the feet by feet_ahead or change the pose in {path}"
            )
        return None


def check_keyframe(robot: Robot, keyframe: Keyframe) -> KeyframeReport:
    """Return the report of a keyframe in which the robot can stand.

    Raises:
        RobotError: if it cannot; the text says by how much and what to change.
    """
    report = examine_keyframe(robot, keyframe)
    problem = report.problem()
    if problem:
        raise RobotError(problem)
    return report


def examine_keyframe(robot: Robot, keyframe: Keyframe) -> KeyframeReport:
    """Measure a keyframe: reach, feet, static torques."""
    model = robot.spec(visuals=False).compile()
    data = mujoco.MjData(model)
    data.qpos[:] = keyframe.qpos
    mujoco.mj_forward(model, data)  # at rest, so qfrc_bias is gravity alone
    contacts = data.geom_xpos[[model.geom(foot).id for foot in robot.foot_geoms]].copy()
    contacts[:, 2] -= robot.foot_radius
    torque, imbalance = _static_torque(model, data, robot, contacts)
    return KeyframeReport(
        robot=robot,
        keyframe=keyframe,
        leg_margin=_leg_margin(model, keyframe, robot),
        foot_height=contacts[:, 2],
        limb_height={
            name: _height(model, data, name) for name in robot.penalised_geoms + robot.base_geoms
        },
        torque=torque,
        imbalance=imbalance,
    )


def _height(model: mujoco.MjModel, data: mujoco.MjData, geom: str) -> float:
    """Return how far a geom is above the floor in m; negative within it."""
    nothing = np.zeros(6)
    ids = model.geom(geom).id, model.geom("floor").id
    return float(mujoco.mj_geomDistance(model, data, *ids, 10.0, nothing))


def _leg_margin(model: mujoco.MjModel, keyframe: Keyframe, robot: Robot) -> float:
    try:
        legs = find_legs(model, robot.base_body, robot.foot_geoms)
    except LegError:
        return float("nan")
    return min(leg.reach[1] - _leg_length(leg, keyframe.joint_pos) for leg in legs)


def _leg_length(leg: Leg, joint_pos: np.ndarray) -> float:
    """Return the distance from hip to foot in m, which the knee alone decides."""
    bend = joint_pos[leg.knee_joint]
    cos, sin = np.cos(bend), np.sin(bend)
    x, z = leg.shank
    return float(np.hypot(leg.thigh[0] + cos * x + sin * z, leg.thigh[1] - sin * x + cos * z))


def _static_torque(
    model: mujoco.MjModel, data: mujoco.MjData, robot: Robot, contacts: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return joint torques (J,) in N m that balance gravity, and the imbalance left over in m.

    Of the forces on the feet that balance the base, the smallest are taken: on flat ground they
    are vertical. A foot that would have to pull is left out.

    Args:
        model: the robot in its scene.
        data: in the pose to hold, at rest, after mj_forward.
        robot: the same robot.
        contacts: lowest point of each foot. Shape (F, 3), m.
    """
    standing = np.flatnonzero(contacts[:, 2] < contacts[:, 2].min() + FOOT_TOLERANCE)
    while True:
        jacobian = np.concatenate(
            [_point_jacobian(model, data, robot.foot_geoms[f], contacts[f]) for f in standing]
        )
        force = np.linalg.lstsq(
            _WEIGHTS[:, None] * jacobian[:, :6].T, _WEIGHTS * data.qfrc_bias[:6], rcond=None
        )[0]
        pulling = force[2::3] < 0
        if not pulling.any() or pulling.all():
            break
        standing = standing[~pulling]
    rest = data.qfrc_bias - jacobian.T @ force
    weight = float(model.body_mass.sum()) * -float(model.opt.gravity[2])
    return rest[6:], float(np.linalg.norm(rest[3:6])) / weight


def _point_jacobian(
    model: mujoco.MjModel, data: mujoco.MjData, foot: str, point: np.ndarray
) -> np.ndarray:
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, point, int(model.geom(foot).bodyid[0]))
    return jacobian
