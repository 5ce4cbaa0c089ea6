"""Deterministic evaluation: noisy rollouts look like gaits that vanish with the noise."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass

import torch
from tensordict import TensorDict

from kiras_rl.evaluation.gait import clearance, lifts_per_second
from kiras_rl.interfaces import Measurements, SkillEnv

SETTLE = 1.0  # s that are not counted
AVERAGE = 0.4  # s of the moving average of height and pitch: about two strides
SEED = 12345  # every evaluation draws the same robots


@dataclass(frozen=True)
class Goal:
    """What a skill should reach, each at most unless said otherwise.

    Attributes:
        height: Error of the height, m.
        pitch: Error of the pitch, rad.
        velocity: Error of v_x, m/s.
        falls: Share of robots.
        lifts: Lifts a second, the least and the most.
        clearance: Share of the height that steps of this skill should have, at least.
        beyond: Share of the control steps with a joint beyond its limits.
        saturated: Share of the physics steps with a motor that gives all it can.
    """

    height: float
    pitch: float
    velocity: float
    falls: float
    lifts: tuple[float, float]
    clearance: float
    beyond: float
    saturated: float


FLOOR = Goal(0.03, math.radians(5.0), 0.12, 0.05, (1.0, 4.5), 0.5, 0.01, 0.05)
"""What a skill must reach to be called learned."""

TARGET = Goal(0.01, math.radians(2.0), 0.08, 0.0, (2.0, 3.5), 1.0, 0.0, 0.001)
"""What a skill should reach."""

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
        most_lifts: Lifts a second of the foot that lifts most.
        clearance: Mean over swings of the largest height of the foot above the ground, of the
            height that steps of this skill should have.
        duty: Share of the time that a foot stands, mean over feet.
        beyond: Share of the control steps with a joint beyond its limits.
        saturated: Share of the physics steps with a motor that gives all that it can.
        power: Mean of the sum over the joints of |torque * velocity|, W.
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
    most_lifts: float
    clearance: float
    duty: float
    beyond: float
    saturated: float
    power: float
    distinct: float
    falls: float

    def meets(self, goal: Goal) -> bool:
        """Return whether posture, velocity, gait and limits all reach a goal."""
        return (
            self.height_error <= goal.height
            and self.pitch_error <= goal.pitch
            and self.velocity_error <= goal.velocity
            and self.falls <= goal.falls
            and goal.lifts[0] <= self.lifts
            and self.most_lifts <= goal.lifts[1]
            and self.clearance >= goal.clearance
            and self.beyond <= goal.beyond
            and self.saturated <= goal.saturated
        )


@dataclass(frozen=True)
class Recording:
    """What N robots did in T steps; see Measurements for frames and units."""

    skill: torch.Tensor  # (N,)
    command: torch.Tensor  # (N, 3)
    height: torch.Tensor  # (T, N)
    pitch: torch.Tensor  # (T, N)
    velocity: torch.Tensor  # (T, N)
    stands: torch.Tensor  # (T, N, F)
    foot_height: torch.Tensor  # (T, N, F)
    beyond: torch.Tensor  # (T, N)
    saturated: torch.Tensor  # (T, N)
    power: torch.Tensor  # (T, N)
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
        (
            *(now.base_height, now.pitch, now.lin_vel_h[:, 0], now.foot_stands, now.foot_height),
            *(now.beyond, now.saturated, power(now), alive),
        )
        for now, alive in walk(env, policy, duration, skill, command)
    ]
    return Recording(
        skill, command, *(torch.stack(x) for x in zip(*steps, strict=True)), step_dt=env.step_dt
    )


def power(now: Measurements) -> torch.Tensor:
    """Return the sum over the joints of |torque * velocity|, (N,), W."""
    return (now.joint_torque * now.joint_vel).abs().sum(dim=-1)


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
        "duty": mean_where(recording.stands.float().mean(dim=-1), weight),
        "beyond": mean_where(recording.beyond.float(), weight),
        "saturated": mean_where(recording.saturated, weight),
        "power": mean_where(recording.power, weight),
        "falls": 1.0 - recording.alive[-1].float(),
    }
    lifts = lifts_per_second(recording.stands, counted, recording.step_dt)
    values |= {"lifts": lifts.amin(dim=-1), "most_lifts": lifts.amax(dim=-1)}
    peaks, swings = clearance(recording.stands, recording.foot_height, counted)
    wanted = env.keyframe_clearance[recording.skill]
    values["clearance"] = peaks / swings.clamp(min=1.0) / wanted
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


def score(results: dict[str, SkillResult]) -> float:
    """Return one number for "how good is this policy": lower is better, 0 is perfect.

    Errors are measured against FLOOR, which makes skills useful. A skill that does not step, steps
    as low as the floor or a lift a second too often, or is beyond its limits in a tenth of its
    steps costs as much as an error at its limit.
    """
    parts = [
        r.height_error / FLOOR.height
        + r.pitch_error / FLOOR.pitch
        + r.velocity_error / FLOOR.velocity
        + max(0.0, 1.0 - r.lifts)
        + max(0.0, r.most_lifts - TARGET.lifts[1])
        + 2.0 * max(0.0, 1.0 - r.clearance)
        + 10.0 * (r.beyond + r.saturated)
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
