"""Observation terms and groups: the YAML lists terms, sizes follow.

A term is a function of `View` that returns (N, k). A group is an ordered list of terms, each with
a scale and the noise that the sensor would have.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from kiras_rl.config import ConfigError
from kiras_rl.envs.lookup import find_function
from kiras_rl.envs.sensing import Sensed
from kiras_rl.envs.shapes import evaluate
from kiras_rl.envs.state import Keyframes, RobotState, Task

SCAN_LIMIT = 1.0  # m

UNITS = {
    "pitch": "rad",
    "roll_pitch": "rad",
    "base_lin_vel": "m/s",
    "base_ang_vel": "rad/s",
    "command_lin_vel_x": "m/s",
    "command_lin_vel_y": "m/s",
    "command_ang_vel_z": "rad/s",
    "joint_pos": "rad",
    "joint_vel": "rad/s",
    "foot_height": "m",
    "base_height": "m",
    "height_scan": "m",
}
"""Of the terms below, before their scale; what is not named has none."""


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
    """

    robot: RobotState
    sensed: RobotState | Sensed
    task: Task
    keyframes: Keyframes
    default_joint_pos: torch.Tensor
    last_action: torch.Tensor


def projected_gravity(view: View) -> torch.Tensor:
    """Return the unit vector of gravity in the base frame, 3."""
    return view.sensed.gravity_b


def pitch(view: View) -> torch.Tensor:
    """Return the pitch, nose down positive, 1, rad."""
    return view.sensed.roll_pitch[:, 1:]


def roll_pitch(view: View) -> torch.Tensor:
    """Return roll and pitch, 2, rad."""
    return view.sensed.roll_pitch


def base_lin_vel(view: View) -> torch.Tensor:
    """Return the linear velocity in the base frame, 3, m/s."""
    return view.robot.base_lin_vel_b


def base_ang_vel(view: View) -> torch.Tensor:
    """Return the angular velocity in the base frame, 3, rad/s."""
    return view.sensed.base_ang_vel_b


def command_lin_vel_x(view: View) -> torch.Tensor:
    """Return the commanded forward velocity, 1, m/s."""
    return view.task.command[:, 0:1]


def command_lin_vel_y(view: View) -> torch.Tensor:
    """Return the commanded lateral velocity, 1, m/s."""
    return view.task.command[:, 1:2]


def command_ang_vel_z(view: View) -> torch.Tensor:
    """Return the commanded yaw rate, 1, rad/s."""
    return view.task.command[:, 2:3]


def skill(view: View) -> torch.Tensor:
    """Return the one-hot code of the commanded skill, S."""
    return view.keyframes.code[view.task.skill]


def joint_pos(view: View) -> torch.Tensor:
    """Return joint angles relative to q0, J, rad."""
    return view.sensed.joint_pos - view.default_joint_pos


def joint_vel(view: View) -> torch.Tensor:
    """Return joint velocities, J, rad/s."""
    return view.sensed.joint_vel


def last_action(view: View) -> torch.Tensor:
    """Return the clipped action of the last step, J."""
    return view.last_action


def foot_height(view: View) -> torch.Tensor:
    """Return the height of each foot's lowest point above the ground, F, m."""
    return view.robot.foot_height


def base_height(view: View) -> torch.Tensor:
    """Return the base height above the ground, 1, m."""
    return view.robot.base_height[:, None]


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
        noise: Half-width of the uniform noise of each number, after the scale, (size,).
    """

    def __init__(self, name: str, terms: dict, view: View) -> None:
        """Look the terms up and derive the sizes by calling them once.

        Raises:
            ConfigError: Unknown term or key, or a term of another shape than (N, k).
        """
        terms = {key: value for key, value in terms.items() if value is not None}
        self.where = where = f"env.observations.{name}"
        self.names = list(terms)
        self._terms = [find_function(globals(), key, View, where) for key in terms]
        _check_keys(terms, where)
        worlds = len(view.last_action)
        outputs = [
            evaluate(term, view, f"{where}.{name}", (worlds, None))
            for name, term in zip(self.names, self._terms, strict=True)
        ]
        self.sizes = [output.shape[1] for output in outputs]
        self.scales = [float(value.get("scale", 1.0)) for value in terms.values()]
        noises = [float(value.get("noise", 0.0)) for value in terms.values()]
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


def _check_keys(terms: dict, where: str) -> None:
    for name, values in terms.items():
        if not isinstance(values, dict):
            raise ConfigError(f"{where}.{name}: give scale and noise, as in {name}: {{scale: 1.0}}")
        unknown = set(values) - {"scale", "noise"}
        if unknown:
            raise ConfigError(
                f"{where}.{name}: unknown key '{sorted(unknown)[0]}'; it takes scale, noise"
            )


def _spread(values: list[float], sizes: list[int], device: torch.device) -> torch.Tensor:
    return torch.repeat_interleave(
        torch.tensor(values, device=device), torch.tensor(sizes, device=device)
    )
