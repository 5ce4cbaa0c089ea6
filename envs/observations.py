"""Observation terms and groups: the YAML lists terms, sizes follow.

A term is a function of `View` that returns (N, k). `observed` says its unit before the scale, and
its twin on the robot where there is one. A group is an ordered list of terms, each with a scale and
the noise that the sensor would have.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch

from kiras_rl.deploy import terms
from kiras_rl.deploy.terms import observed, path_of
from kiras_rl.envs.lookup import find_term
from kiras_rl.envs.sensing import Sensed
from kiras_rl.envs.shapes import evaluate
from kiras_rl.envs.state import Keyframes, RobotState, Task

SCAN_LIMIT = 1.0  # m


@dataclass
class View:
    """What observation terms may look at.

    Attributes:
        robot: The robots now.
        sensed: What the robots themselves read of that; `robot` for a view without errors.
        task: Their tasks.
        keyframes: The skills.
        default_joint_pos: q0, (J,), rad.
        last_action: Clipped action of the last step, (N, J).
        physics: Friction of the robots' geoms, and payload in kg, (N, 2); those of the MJCF where
            neither is among the observations.
    """

    robot: RobotState
    sensed: RobotState | Sensed
    task: Task
    keyframes: Keyframes
    default_joint_pos: torch.Tensor
    last_action: torch.Tensor
    physics: torch.Tensor


@observed(onboard=terms.projected_gravity)
def projected_gravity(view: View) -> torch.Tensor:
    """Return the unit vector of gravity in the base frame, 3."""
    return view.sensed.gravity_b


@observed(unit="rad", onboard=terms.pitch)
def pitch(view: View) -> torch.Tensor:
    """Return the pitch, nose down positive, 1, rad."""
    return view.sensed.roll_pitch[:, 1:]


@observed(unit="rad")
def roll_pitch(view: View) -> torch.Tensor:
    """Return roll and pitch, 2, rad."""
    return view.sensed.roll_pitch


@observed(unit="m/s")
def base_lin_vel(view: View) -> torch.Tensor:
    """Return the linear velocity in the base frame, 3, m/s."""
    return view.robot.base_lin_vel_b


@observed(unit="rad/s", onboard=terms.base_ang_vel)
def base_ang_vel(view: View) -> torch.Tensor:
    """Return the angular velocity in the base frame, 3, rad/s."""
    return view.sensed.base_ang_vel_b


@observed(unit="m/s", onboard=terms.command_lin_vel_x)
def command_lin_vel_x(view: View) -> torch.Tensor:
    """Return the commanded forward velocity, 1, m/s."""
    return view.task.command[:, 0:1]


@observed(unit="m/s", onboard=terms.command_lin_vel_y)
def command_lin_vel_y(view: View) -> torch.Tensor:
    """Return the commanded lateral velocity, 1, m/s."""
    return view.task.command[:, 1:2]


@observed(unit="rad/s", onboard=terms.command_ang_vel_z)
def command_ang_vel_z(view: View) -> torch.Tensor:
    """Return the commanded yaw rate, 1, rad/s."""
    return view.task.command[:, 2:3]


@observed(onboard=terms.skill)
def skill(view: View) -> torch.Tensor:
    """Return the one-hot code of the commanded skill, S."""
    return view.keyframes.code[view.task.skill]


@observed(unit="rad", onboard=terms.joint_pos)
def joint_pos(view: View) -> torch.Tensor:
    """Return joint angles relative to q0, J, rad."""
    return view.sensed.joint_pos - view.default_joint_pos


@observed(unit="rad/s", onboard=terms.joint_vel)
def joint_vel(view: View) -> torch.Tensor:
    """Return joint velocities, J, rad/s."""
    return view.sensed.joint_vel


@observed(onboard=terms.last_action)
def last_action(view: View) -> torch.Tensor:
    """Return the clipped action of the last step, J."""
    return view.last_action


@observed()
def friction(view: View) -> torch.Tensor:
    """Return the coefficient of friction between robot and ground, 1."""
    return view.physics[:, :1]


@observed(unit="kg")
def payload(view: View) -> torch.Tensor:
    """Return the mass that is added to the base, 1, kg."""
    return view.physics[:, 1:]


@observed(unit="m")
def foot_height(view: View) -> torch.Tensor:
    """Return the height of each foot's lowest point above the ground, F, m."""
    return view.robot.foot_height


@observed(unit="m")
def base_height(view: View) -> torch.Tensor:
    """Return the base height above the ground, 1, m."""
    return view.robot.base_height[:, None]


@observed(unit="m")
def height_scan(view: View) -> torch.Tensor:
    """Return base minus ground height at 9 x 7 points, relative to the first keyframe, 63, m."""
    relative = view.robot.height_scan() - view.keyframes.height[0]
    return relative.clamp(-SCAN_LIMIT, SCAN_LIMIT)


class ObservationGroup:
    """An ordered list of scaled terms.

    Attributes:
        where: Key of the group in the YAML.
        names: Terms in order.
        sizes: Numbers of each term.
        scales: Scale of each term.
        units: Unit of each term before its scale; empty for none.
        onboard: What rebuilds each term on a robot, as a policy file names it; None where the name
            of the term says it.
        noise: Half-width of the uniform noise of each number, after the scale, (size,).
        tells_physics: Whether `friction` or `payload` is among the terms.
    """

    def __init__(self, name: str, entries: dict, view: View) -> None:
        """Look the terms up and derive the sizes by calling them once.

        Raises:
            ConfigError: Unknown term or key, or a term of another shape than (N, k).
        """
        entries = {key: value for key, value in entries.items() if value is not None}
        self.where = where = f"env.observations.{name}"
        self.names = list(entries)
        self._terms = [_find(key, entry, where) for key, entry in entries.items()]
        self.units = [getattr(term.func, "unit", "") for term in self._terms]
        self.onboard = [
            _twin(name, term.func) for name, term in zip(self.names, self._terms, strict=True)
        ]
        self.tells_physics = any(term.func in (friction, payload) for term in self._terms)
        worlds = len(view.last_action)
        outputs = [
            evaluate(term, view, f"{where}.{name}", (worlds, None))
            for name, term in zip(self.names, self._terms, strict=True)
        ]
        self.sizes = [output.shape[1] for output in outputs]
        self.scales = [float(value.get("scale", 1.0)) for value in entries.values()]
        noises = [float(value.get("noise", 0.0)) for value in entries.values()]
        device = outputs[0].device
        self._scale = _spread(self.scales, self.sizes, device)
        self.noise = _spread(noises, self.sizes, device) * self._scale

    @property
    def size(self) -> int:
        """Length of the group's vector."""
        return sum(self.sizes)

    def __call__(self, view: View) -> torch.Tensor:
        """Return the noise-free vector, (N, size)."""
        return torch.cat([term(view) for term in self._terms], dim=1) * self._scale


def _find(name: str, entry: dict, where: str) -> partial[torch.Tensor]:
    hint = "scale and noise, as in %s: {scale: 1.0}"
    return find_term(globals(), name, entry, View, where, ("scale", "noise"), hint, "key")


def _twin(name: str, function: Callable) -> str | None:
    """Return how a policy file names what rebuilds a term, None where its own name says it.

    A term that nothing rebuilds is named itself: so it is none of the robot's that has its name.
    """
    path = path_of(getattr(function, "onboard", None) or function)
    return None if path == name else path


def _spread(values: list[float], sizes: list[int], device: torch.device) -> torch.Tensor:
    return torch.repeat_interleave(
        torch.tensor(values, device=device), torch.tensor(sizes, device=device)
    )


UNITS = {
    name: term.unit
    for name, term in tuple(globals().items())
    if getattr(term, "unit", "") and inspect.isfunction(term)
}
"""Of the terms of this module that have one, before their scale."""
