"""How near a policy takes joints and motors to what the robot allows, over the range of commands.

Letters: N robots, J joints, S skills.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import torch
from torch.quasirandom import SobolEngine

from kiras_rl.evaluation.flat import Policy, power, walk
from kiras_rl.interfaces import Measurements, SkillEnv

SETTLE = 1.0  # s that are not counted: a reset is no fault of the policy's


@dataclass(frozen=True)
class SkillLimits:
    """One skill; shares and means are over the steps of all robots until they fall.

    Attributes:
        beyond: Share of the control steps with a joint beyond its limits.
        margin: Least distance of any joint from its limits, rad; negative beyond them.
        speeding: Share of the control steps with a joint faster than its limit.
        speed: Largest speed of a joint, of its limit.
        saturated: Share of the physics steps with a motor at its torque limit.
        torque: Largest torque of a joint, of its limit.
        power: Mean of the sum over the joints of |torque * velocity|, W.
        peak_power: Largest of that, W.
        falls: Share of robots that fell.
    """

    beyond: float
    margin: float
    speeding: float
    speed: float
    saturated: float
    torque: float
    power: float
    peak_power: float
    falls: float


def spread_commands(
    robots: int, ranges: tuple[tuple[float, float], ...], device: torch.device
) -> torch.Tensor:
    """Return commands that fill the ranges of v_x, v_y and yaw rate evenly, (robots, 3)."""
    low, high = torch.tensor(ranges).T
    return (low + (high - low) * SobolEngine(3, scramble=True, seed=1).draw(robots)).to(device)


def evaluate_limits(
    env: SkillEnv,
    policy: Policy,
    ranges: tuple[tuple[float, float], ...],
    duration: float,
) -> dict[str, SkillLimits]:
    """Walk every skill from its keyframe, each robot by a command of its own.

    Args:
        env: Worlds are dealt to the skills in turn, N of them.
        policy: Observation -> mean actions.
        ranges: Lowest and highest v_x and v_y, m/s, and yaw rate, rad/s.
        duration: Of each trial, s.
    """
    skills = len(env.skills)
    skill = torch.arange(env.num_envs, device=env.device) % skills
    commands = spread_commands(env.num_envs // skills, ranges, env.device)
    commands = commands.repeat_interleave(skills, dim=0)
    start = round(SETTLE / env.step_dt)
    steps = [
        (*_measured(now, env), alive) for now, alive in walk(env, policy, duration, skill, commands)
    ]
    signals = [torch.stack(x) for x in zip(*steps, strict=True)]  # (T, N) each
    falls = 1.0 - signals[-1][-1].float()
    signals = [signal[start:] for signal in signals]
    return {
        name: _reduce([signal[:, skill == i] for signal in signals], falls[skill == i])
        for i, name in enumerate(env.skills)
    }


def _measured(now: Measurements, env: SkillEnv) -> tuple[torch.Tensor, ...]:
    """Return margin, rad, speed and torque, of their limits, power, W, saturation, (N,) each."""
    low, high = env.joint_limits
    margin = torch.minimum(now.joint_pos - low, high - now.joint_pos)
    return (
        margin.amin(dim=1),
        (now.joint_vel.abs() / env.velocity_limit).amax(dim=1),
        (now.peak_torque / env.torque_limit).amax(dim=1),
        power(now),
        now.saturated,
    )


def _reduce(signals: list[torch.Tensor], falls: torch.Tensor) -> SkillLimits:
    margin, speed, torque, watts, saturated, alive = signals
    counted = alive if alive.any() else torch.ones_like(alive)
    margin, speed, torque, watts, saturated = (
        signal[counted] for signal in (margin, speed, torque, watts, saturated)
    )
    return SkillLimits(
        beyond=(margin < 0.0).float().mean().item(),
        margin=margin.min().item(),
        speeding=(speed > 1.0).float().mean().item(),
        speed=speed.max().item(),
        saturated=saturated.mean().item(),
        torque=torque.max().item(),
        power=watts.mean().item(),
        peak_power=watts.max().item(),
        falls=falls.mean().item(),
    )


def as_dict(results: dict[str, SkillLimits]) -> dict[str, dict[str, float | None]]:
    """Return plain values for JSON; None for the margin of joints without limits."""
    return {
        name: {key: value if math.isfinite(value) else None for key, value in asdict(r).items()}
        for name, r in results.items()
    }
