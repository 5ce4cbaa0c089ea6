"""Deterministic evaluation: noisy rollouts look like gaits that vanish with the noise."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass

import torch
from tensordict import TensorDict

from kiras_rl.interfaces import Measurements, SkillEnv

SETTLE = 1.0  # s that are not counted
AVERAGE = 0.4  # s of the moving average of height and pitch: about two strides
SEED = 12345  # every evaluation draws the same robots

FLOOR = {"height": 0.03, "pitch": math.radians(5.0), "velocity": 0.12, "falls": 0.05}
"""What a skill must reach to be called learned: m, rad, m/s, share of robots."""

Policy = Callable[[TensorDict], torch.Tensor]


@dataclass(frozen=True)
class SkillResult:
    """One skill, averaged over its robots and the time after the first second.

    Attributes:
        height: Mean base height, m.
        pitch: Mean pitch, rad.
        velocity: Mean v_x in the heading frame, m/s.
        height_error: Mean |height - keyframe| of the moving average, m.
        pitch_error: Mean |pitch - keyframe| of the moving average, rad.
        velocity_error: Mean |v_x - command|, at each step, m/s.
        lifts: Lifts a second of the foot that lifts least.
        distinct: Share of robots whose mean height and pitch are nearest their own keyframe.
        falls: Share of robots that fell.
    """

    height: float
    pitch: float
    velocity: float
    height_error: float
    pitch_error: float
    velocity_error: float
    lifts: float
    distinct: float
    falls: float

    def meets(self, height: float, pitch: float, velocity: float, falls: float) -> bool:
        """Return whether errors (m, rad, m/s) and falls stay within limits and the robot steps."""
        return (
            self.height_error <= height
            and self.pitch_error <= pitch
            and self.velocity_error <= velocity
            and self.falls <= falls
            and self.lifts >= 1.0
        )


@dataclass(frozen=True)
class Recording:
    """What N robots did in T steps; see Measurements for frames and units."""

    skill: torch.Tensor  # (N,)
    command: torch.Tensor  # (N, 3)
    height: torch.Tensor  # (T, N)
    pitch: torch.Tensor  # (T, N)
    velocity: torch.Tensor  # (T, N)
    contact: torch.Tensor  # (T, N, F)
    alive: torch.Tensor  # (T, N): not fallen up to and including this step
    step_dt: float


def evaluate_skills(
    env: SkillEnv, policy: Policy, duration: float, command: float
) -> dict[str, SkillResult]:
    """Walk every skill straight ahead from its own keyframe.

    Args:
        env: Worlds are dealt to the skills in turn.
        policy: Observation -> mean actions.
        duration: Of each trial, s.
        command: v_x, m/s.
    """
    recording = record(env, policy, duration, *deal_skills(env, command))
    return summarize(recording, env)


@torch.no_grad()
def walk(
    env: SkillEnv, policy: Policy, duration: float, skill: torch.Tensor, command: torch.Tensor
) -> Iterator[tuple[Measurements, torch.Tensor]]:
    """Run the policy from the keyframes of `skill` (N,) with constant commands (N, 3).

    Yields:
        What was measured after each step, and which robots have not fallen until then, (N,) bool.
    """
    env.seed(SEED)
    obs = env.reset(skill, command)
    alive = torch.ones(env.num_envs, dtype=torch.bool, device=env.device)
    for _ in range(round(duration / env.step_dt)):
        obs = env.step(policy(obs))[0]
        now = env.measure()
        alive = alive & ~now.fallen
        yield now, alive


def record(
    env: SkillEnv, policy: Policy, duration: float, skill: torch.Tensor, command: torch.Tensor
) -> Recording:
    """Walk as `walk` does, and keep what the protocol counts."""
    steps = [
        (now.base_height, now.pitch, now.lin_vel_h[:, 0], now.foot_contact, alive)
        for now, alive in walk(env, policy, duration, skill, command)
    ]
    height, pitch, velocity, contact, alive = (torch.stack(x) for x in zip(*steps, strict=True))
    return Recording(skill, command, height, pitch, velocity, contact, alive, env.step_dt)


def deal_skills(env: SkillEnv, command: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Deal the worlds to the skills in turn.

    Returns:
        The skills, (N,), and the commands straight ahead at `command` m/s, (N, 3).
    """
    skill = torch.arange(env.num_envs, device=env.device) % len(env.skills)
    commands = torch.zeros(env.num_envs, 3, device=env.device)
    commands[:, 0] = command
    return skill, commands


def summarize(recording: Recording, env: SkillEnv) -> dict[str, SkillResult]:
    """Reduce a recording to one result a skill; a robot counts until it falls."""
    values = per_robot(recording, env)
    results = {}
    for index, name in enumerate(env.skills):
        mine = recording.skill == index
        results[name] = SkillResult(**{key: x[mine].mean().item() for key, x in values.items()})
    return results


def per_robot(recording: Recording, env: SkillEnv) -> dict[str, torch.Tensor]:
    """Return the fields of SkillResult for each robot, (N,) each."""
    counted = _counted(recording.alive, round(SETTLE / recording.step_dt))
    weight, velocity = counted.float(), recording.velocity
    values = {
        "height": mean_where(recording.height, weight),
        "pitch": mean_where(recording.pitch, weight),
        "velocity": mean_where(velocity, weight),
        "velocity_error": mean_where((velocity - recording.command[:, 0]).abs(), weight),
        "lifts": lifts_per_second(recording.contact, counted, recording.step_dt).amin(dim=-1),
        "falls": 1.0 - recording.alive[-1].float(),
    }
    errors = posture_errors(recording.height, recording.pitch, recording.skill, env)
    for name, error in zip(("height_error", "pitch_error"), errors, strict=True):
        values[name] = mean_where(error, weight)
    return values | {"distinct": _distinct(values["height"], values["pitch"], recording, env)}


def _counted(alive: torch.Tensor, start: int) -> torch.Tensor:
    """Return the steps that count, (T, N): from `start` on until a fall.

    Of a robot that fell before, those until its fall: what comes after is another life.
    """
    settled = torch.arange(len(alive), device=alive.device)[:, None] >= start
    return alive & (settled | ~alive[start : start + 1].any(dim=0))


def posture_errors(
    height: torch.Tensor, pitch: torch.Tensor, skill: torch.Tensor, env: SkillEnv
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return how far moving averages are from their keyframes, (T, N) each, m and rad.

    Args:
        height: Above the ground, (T, N), m.
        pitch: (T, N), rad.
        skill: Whose keyframe, (N,).
        env: With the keyframes.
    """
    height, pitch = (moving_average(signal, env.step_dt) for signal in (height, pitch))
    return (
        (height - env.keyframe_height[skill]).abs(),
        (pitch - env.keyframe_pitch[skill]).abs(),
    )


def moving_average(signal: torch.Tensor, step_dt: float) -> torch.Tensor:
    """Average each step of (T, N) with the AVERAGE seconds before it."""
    width = round(AVERAGE / step_dt)
    padded = torch.cat([signal[:1].expand(width - 1, -1), signal])
    return padded.unfold(0, width, 1).mean(dim=-1)


def lifts_per_second(contact: torch.Tensor, alive: torch.Tensor, step_dt: float) -> torch.Tensor:
    """Return how often each foot leaves the ground before the robot falls, (N, F), 1/s.

    Args:
        contact: (T, N, F) bool.
        alive: Steps that count, all before the fall, (T, N) bool.
        step_dt: s.
    """
    lifted = contact[:-1] & ~contact[1:] & (alive[:-1] & alive[1:])[:, :, None]
    return lifted.sum(dim=0) / (alive.sum(dim=0).clamp(min=1)[:, None] * step_dt)


def score(results: dict[str, SkillResult]) -> float:
    """Return one number for "how good is this policy": lower is better, 0 is perfect.

    Errors are measured against the limits that make skills useful (3 cm, 5 degrees, 0.12 m/s); a
    fall or a skill that does not step costs as much as an error at its limit.
    """
    parts = [
        r.height_error / 0.03
        + r.pitch_error / 0.087
        + r.velocity_error / 0.12
        + max(0.0, 1.0 - r.lifts)
        + 2.0 * r.falls
        for r in results.values()
    ]
    return sum(parts) / len(parts)


def as_scalars(results: dict[str, SkillResult]) -> dict[str, float]:
    """Return the results by log name, Eval_<skill>/<quantity>."""
    scalars = {"Eval/score": score(results)}
    for skill, result in results.items():
        scalars |= {f"Eval_{skill}/{key}": value for key, value in asdict(result).items()}
    return scalars


def mean_where(signal: torch.Tensor, alive: torch.Tensor) -> torch.Tensor:
    """Average (T, N) over the steps that count; 0 steps give the value of the first one."""
    count = alive.sum(dim=0)
    mean = torch.where(alive > 0, signal, 0.0).sum(dim=0) / count.clamp(min=1.0)
    return torch.where(count > 0, mean, signal[0])


def _distinct(
    height: torch.Tensor, pitch: torch.Tensor, recording: Recording, env: SkillEnv
) -> torch.Tensor:
    """Return whether the nearest keyframe (1 cm counts as 1.5 degrees) is the robot's own."""
    weight = 0.01 / 0.026
    distance = (height[:, None] - env.keyframe_height).square() + (
        weight * (pitch[:, None] - env.keyframe_pitch)
    ).square()
    return (distance.argmin(dim=1) == recording.skill).float()
