"""Reward terms: one pure function each, (Step, parameters of the YAML) -> (N,).

A term's value is positive and its weight in the YAML gives the sign; only `feet_drag` is negative,
for the paper gives it a positive weight. The paper's table is cfg/paper.yaml.

A weight is a number, or a schedule of [share of the phase, weight] points. `penalty_scale` lets the
negative ones grow over a phase, but for terms that are `whole: true`.

Terms of the gait judge a foot when it lands or lifts off, from what is remembered of its swing or
stance (kiras_rl.envs.memory), and leave a robot alone that is told to stand.
"""

from __future__ import annotations

from functools import partial

import torch

from kiras_rl.config import ConfigError
from kiras_rl.envs.lookup import find_term
from kiras_rl.envs.memory import remembering
from kiras_rl.envs.shapes import evaluate
from kiras_rl.envs.state import Step
from kiras_rl.schedules import piecewise_linear
from kiras_rl.schema import RewardConfig


def tracking_lin_vel(step: Step, sigma: float, lateral: float = 0.0) -> torch.Tensor:
    """Return exp(-error^2 / sigma) of the horizontal velocity; `lateral` weighs the y error."""
    error = (step.task.command[:, :2] - step.robot.base_lin_vel_h[:, :2]).square()
    return torch.exp(-(error[:, 0] + lateral * error[:, 1]) / sigma)


def tracking_ang_vel(step: Step, sigma: float) -> torch.Tensor:
    """Return exp(-error^2 / sigma) of the yaw rate."""
    return torch.exp(-(step.task.command[:, 2] - step.robot.yaw_rate).square() / sigma)


def action_rate(step: Step) -> torch.Tensor:
    """Return the norm of the change of action."""
    return torch.linalg.vector_norm(step.action - step.last_action, dim=-1)


def action_rate_squared(step: Step) -> torch.Tensor:
    """Return the squared norm of the change of action, as legged_gym defines it."""
    return (step.action - step.last_action).square().sum(-1)


def torques(step: Step) -> torch.Tensor:
    """Return the sum of squared joint torques, (N m)^2."""
    return step.robot.joint_torque.square().sum(-1)


def delta_torques(step: Step) -> torch.Tensor:
    """Return the sum of squared changes of joint torque, (N m)^2; zero after a reset."""
    change = (step.robot.joint_torque - step.last_joint_torque).square().sum(-1)
    return torch.where(step.fresh, 0.0, change)


def joint_acceleration(step: Step) -> torch.Tensor:
    """Return the sum of squared mean joint accelerations, (rad/s^2)^2."""
    return ((step.robot.joint_vel - step.last_joint_vel) / step.dt).square().sum(-1)


def ang_vel_xy(step: Step) -> torch.Tensor:
    """Return the squared roll and pitch rates, (rad/s)^2."""
    return step.robot.base_ang_vel_b[:, :2].square().sum(-1)


def ang_vel_x_abs(step: Step) -> torch.Tensor:
    """Return the absolute roll rate, rad/s."""
    return step.robot.base_ang_vel_b[:, 0].abs()


def ang_vel_z_abs(step: Step) -> torch.Tensor:
    """Return the absolute yaw rate, rad/s."""
    return step.robot.base_ang_vel_b[:, 2].abs()


def lin_vel_y(step: Step) -> torch.Tensor:
    """Return the squared lateral velocity, (m/s)^2."""
    return step.robot.base_lin_vel_h[:, 1].square()


def lin_vel_y_abs(step: Step) -> torch.Tensor:
    """Return the absolute lateral velocity, m/s."""
    return step.robot.base_lin_vel_h[:, 1].abs()


def lin_vel_z(step: Step) -> torch.Tensor:
    """Return the squared vertical velocity, (m/s)^2."""
    return step.robot.base_lin_vel_h[:, 2].square()


def foot_slip(step: Step) -> torch.Tensor:
    """Return the sum of squared horizontal speeds of the standing feet, (m/s)^2."""
    speed = step.robot.foot_vel_w[..., :2].square().sum(-1)
    return (speed * step.robot.foot_contact).sum(-1)


def foot_clearance(step: Step, height: float) -> torch.Tensor:
    """Return the sum over feet of horizontal speed times what is missing to `height`, m^2/s.

    A foot that moves ahead should do so high: one that stands costs nothing.
    """
    missing = (height - step.robot.foot_height).clamp(min=0.0)
    speed = torch.linalg.vector_norm(step.robot.foot_vel_w[..., :2], dim=-1)
    return (missing * speed).sum(-1)


def air_time(before: torch.Tensor, step: Step) -> torch.Tensor:
    """Remember for how long each foot has been off the ground, (N, F), s."""
    return (before + step.dt) * ~step.robot.foot_stands


def stance_time(before: torch.Tensor, step: Step) -> torch.Tensor:
    """Remember for how long each foot has stood, (N, F), s."""
    return (before + step.dt) * step.robot.foot_stands


def swing_peak(before: torch.Tensor, step: Step) -> torch.Tensor:
    """Remember how high each foot has been in its swing over what lies ahead of it, (N, F), m."""
    return torch.maximum(before, step.robot.foot_clearance) * ~step.robot.foot_stands


def descent(before: torch.Tensor, step: Step) -> torch.Tensor:
    """Remember how fast each foot in the air comes down, (N, F), m/s."""
    return (-step.robot.foot_vel_w[..., 2]).clamp(min=0.0) * ~step.robot.foot_stands


@remembering(air_time)
def feet_air_time(step: Step, target: float) -> torch.Tensor:
    """Return by how much the feet that land now were in the air longer than `target`, summed, s.

    Short steps cost, long ones earn.
    """
    return ((step.memory[air_time] - target) * _landing(step)).sum(-1) * step.moves


@remembering(air_time)
def short_swing(step: Step, least: float) -> torch.Tensor:
    """Return the sum over feet that land of the share of `least` s that their swing lacks."""
    lacking = (1.0 - step.memory[air_time] / least).clamp(min=0.0)
    return (lacking * _landing(step)).sum(-1) * step.moves


@remembering(stance_time)
def short_stance(step: Step, least: float) -> torch.Tensor:
    """Return the sum over feet that lift off of the share of `least` s that their stance lacks."""
    stood = step.memory[stance_time]
    lifting = ~step.robot.foot_stands & (stood > 0.0)
    return ((1.0 - stood / least).clamp(min=0.0) * lifting).sum(-1) * step.moves


@remembering(air_time, swing_peak)
def low_swing(step: Step, factor: float) -> torch.Tensor:
    """Return the sum over feet that land of the squared share of the height that they lacked.

    Args:
        step: The step.
        factor: Of the clearance that steps of the skill should have.
    """
    wanted = (factor * step.keyframes.clearance[step.task.skill])[:, None]
    lacking = (1.0 - step.memory[swing_peak] / wanted).clamp(min=0.0).square()
    return (lacking * _landing(step)).sum(-1) * step.moves


@remembering(air_time, descent)
def hard_landing(step: Step, most: float) -> torch.Tensor:
    """Return the sum over feet that land of the square of what they came down faster than `most`.

    In (m/s)^2. A price from 0 m/s on would pay for low steps.
    """
    excess = (step.memory[descent] - most).clamp(min=0.0)
    return (excess.square() * _landing(step)).sum(-1) * step.moves


@remembering(stance_time, air_time)
def idle_feet(step: Step, most: float) -> torch.Tensor:
    """Return the number of feet that have neither lifted off nor landed for over `most` s."""
    idle = (step.memory[stance_time] > most) | (step.memory[air_time] > most)
    return idle.float().sum(-1) * step.moves


def flight(step: Step, feet: float) -> torch.Tensor:
    """Return how many feet fewer than `feet` are on the ground."""
    standing = step.robot.foot_stands.float().sum(-1)
    return (feet - standing).clamp(min=0.0) * step.moves


def joint_limits(step: Step, margin: float) -> torch.Tensor:
    """Return how far joints and targets are outside limits that are `margin` narrower, rad."""
    angles = torch.cat([step.robot.joint_pos[:, None], step.target[:, None]], dim=1)
    return step.limits.beyond(angles, margin).sum(dim=(1, 2))


def torque_limits(step: Step, share: float) -> torch.Tensor:
    """Return the sum of torques beyond a `share` of their limits, in limits."""
    used = step.robot.peak_torque / step.limits.torque
    return (used - share).clamp(min=0.0).sum(-1)


def feet_drag(step: Step) -> torch.Tensor:
    """Return minus the summed |v_x| + |v_y| of the standing feet, m/s (weight +0.5 [paper])."""
    speed = step.robot.foot_vel_w[..., :2].abs().sum(-1)
    return -(speed * step.robot.foot_contact).sum(-1)


def feet_contact_forces(step: Step, threshold: float, largest: float) -> torch.Tensor:
    """Return the sum of foot forces above `threshold`, each excess at most `largest`, N."""
    return (step.robot.foot_force - threshold).clamp(0.0, largest).sum(-1)


def collision(step: Step, threshold: float) -> torch.Tensor:
    """Return the number of penalised geoms that press with more than `threshold` N."""
    return (step.robot.limb_force > threshold).float().sum(-1)


def stand_still(step: Step) -> torch.Tensor:
    """Return the sum of absolute joint velocities when asked to stand, rad/s."""
    return torch.where(step.stands, step.robot.joint_vel.abs().sum(-1), 0.0)


def raised_feet(step: Step) -> torch.Tensor:
    """Return the number of feet off the ground when asked to stand."""
    return (~step.robot.foot_stands).float().sum(-1) * step.stands


def stand_still_pose(step: Step) -> torch.Tensor:
    """Return the sum of |q - keyframe| when asked to stand, rad."""
    error = (step.robot.joint_pos - step.keyframes.joint_pos[step.task.skill]).abs().sum(-1)
    return torch.where(step.stands, error, 0.0)


def skill_height(step: Step, sigma: float, slack: float = 0.0) -> torch.Tensor:
    """Return exp(-(error / sigma)^2) of the base height; errors up to `slack` m cost nothing."""
    error = (step.robot.base_height - step.keyframes.height[step.task.skill]).abs()
    return torch.exp(-((error - slack).clamp(min=0.0) / sigma).square())


def skill_orientation(step: Step, sigma: float, slack: float = 0.0) -> torch.Tensor:
    """Return exp(-(error / sigma)^2) of projected gravity; errors up to `slack` cost nothing."""
    error = step.robot.gravity_b - step.keyframes.gravity_b[step.task.skill]
    error = torch.linalg.vector_norm(error, dim=-1)
    return torch.exp(-((error - slack).clamp(min=0.0) / sigma).square())


def termination(step: Step) -> torch.Tensor:
    """Return 1 where an episode ends by failure."""
    return step.fallen.float()


def limb_load(step: Step) -> torch.Tensor:
    """Return the sum of the loads of thighs and shanks, body weights, each at most 1.

    Unlike a count of touches it tells a scrape from a knee that is walked on.
    """
    return (step.robot.limb_force / step.weight).clamp(max=1.0).sum(-1)


@remembering(air_time)
def edge_landing(step: Step, reach: float, drop: float) -> torch.Tensor:
    """Return the number of feet that land where the ground falls by `drop` m within `reach` m."""
    near_edge = step.robot.ground_drop(reach) > drop
    return (near_edge & _landing(step)).float().sum(-1)


def stumble(step: Step, friction: float) -> torch.Tensor:
    """Return the sum of what pushes feet sideways beyond `friction`, body weights, each at most 1.

    A foot meets a riser or the side of a bar.
    """
    return (step.robot.side_force(friction) / step.weight).clamp(max=1.0).sum(-1)


def _landing(step: Step) -> torch.Tensor:
    """Return the feet that stand and did not before, (N, F) bool."""
    return step.robot.foot_stands & (step.memory[air_time] > 0.0)


class RewardSum:
    """The weighted configured terms, and what they amount to."""

    def __init__(self, config: RewardConfig, step_dt: float, device: torch.device) -> None:
        """Look the terms up; `functions` are those without their parameters.

        Raises:
            ConfigError: Unknown term or parameter, or a parameter that is no number.
        """
        terms = {name: values for name, values in config.terms.items() if values is not None}
        self.names = list(terms)
        self.is_termination = torch.tensor([n == "termination" for n in terms], device=device)
        self._terms = [_bind(name, values) for name, values in terms.items()]
        self.functions = [term.func for term in self._terms]
        self._scale = step_dt if config.scale_by_dt else 1.0
        self._penalty_scale, self._sigma = config.penalty_scale, config.sigma
        self._schedules = [_schedule(values["weight"]) for values in terms.values()]
        self._whole = torch.tensor([bool(values.get("whole")) for values in terms.values()])
        self._weights = torch.empty(len(terms), device=device)
        self.set_progress(1.0)

    def set_progress(self, progress: float) -> None:
        """Set the weights to those of this share of the phase, in [0, 1]."""
        weights = torch.tensor([piecewise_linear(p, progress) for p in self._schedules])
        penalty = piecewise_linear(self._penalty_scale, progress)
        weights = torch.where((weights < 0.0) & ~self._whole, penalty * weights, weights)
        self._weights.copy_(self._scale * weights)  # in place: a graph reads it

    def __call__(self, step: Step) -> torch.Tensor:
        """Return the weighted terms, (N, number of terms).

        Raises:
            ConfigError: A term of another shape than one number per world.
        """
        shape = (len(step.fallen),)
        values = [
            evaluate(term, step, f"env.rewards.terms.{name}", shape)
            for name, term in zip(self.names, self._terms, strict=True)
        ]
        return torch.stack(values, dim=1) * self._weights

    def total(self, terms: torch.Tensor) -> torch.Tensor:
        """Return the reward, (N,), of weighted terms (N, number of terms).

        That is their sum, or with `sigma` the positive ones times exp(sum of the negative ones /
        sigma), which is never negative: a penalty cannot make an early end pay.
        """
        if self._sigma is None:
            return terms.sum(dim=1)
        earned, paid = terms.clamp(min=0.0).sum(dim=1), terms.clamp(max=0.0).sum(dim=1)
        return earned * torch.exp(paid / self._sigma)


def _bind(name: str, values: dict) -> partial[torch.Tensor]:
    where = "env.rewards.terms"
    own, hint = ("weight", "whole"), "a weight, as in %s: {weight: 1.0}"
    term = find_term(globals(), name, values, Step, where, own, hint)
    if "weight" not in values:
        raise ConfigError(f"{where}.{name}: no weight; it takes weight")
    if not isinstance(values.get("whole", False), bool):
        raise ConfigError(f"{where}.{name}.whole={values['whole']!r}: must be true or false")
    return term


def _schedule(weight: float | list[list[float]]) -> list[list[float]]:
    """Return the weight as [share of the phase, weight] points."""
    return weight if isinstance(weight, list) else [[0.0, weight]]
