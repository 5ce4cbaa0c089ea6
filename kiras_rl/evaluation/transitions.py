"""How well a policy changes from one skill to another while walking."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from kiras_rl.evaluation.flat import SEED, Policy, moving_average
from kiras_rl.interfaces import SkillEnv

BEFORE = 2.0  # s of walking in the first skill
AFTER = 3.0  # s that are watched after the switch
HEIGHT_BAND = 0.015  # m around the new keyframe's height
PITCH_BAND = math.radians(3.0)  # rad around its pitch
HOLD = 0.3  # s within both bands: settled
LIMIT = 2.0  # s within which a transition must settle
NEAR = 0.5  # s after the switch, and before it, in which its smoothness is judged


@dataclass(frozen=True)
class Transitions:
    """Results of every ordered pair of skills, rows from, columns to; the diagonal is empty.

    Attributes:
        fell: Share of trials with a fall, (S, S).
        settled: Share of trials that were in the first skill before the switch, did not fall, and
            settled in the second within LIMIT, (S, S).
        settle_time: Mean time to settle of those that did, (S, S), s.
        height_overshoot: Largest way of the moving average beyond the new keyframe's height, in
            the direction of the change; mean over trials without a fall, (S, S), m.
        pitch_overshoot: The same of the pitch, (S, S), rad.
        velocity_error: Mean |v_x - command| within LIMIT of the switch, (S, S), m/s.
        jerk: Largest |second difference of the base velocity| within NEAR after the switch, over
            its largest within NEAR before; 1 is as smooth as walking on, (S, S).
        action_rate: The same of |change of action| in a step, (S, S).
        trials: Trials of each pair.
    """

    fell: torch.Tensor
    settled: torch.Tensor
    settle_time: torch.Tensor
    height_overshoot: torch.Tensor
    pitch_overshoot: torch.Tensor
    velocity_error: torch.Tensor
    jerk: torch.Tensor
    action_rate: torch.Tensor
    trials: int

    def overall(self) -> tuple[float, float]:
        """Return the shares of all trials that fell and that settled."""
        pairs = ~torch.eye(len(self.fell), dtype=torch.bool)
        return self.fell[pairs].mean().item(), self.settled[pairs].mean().item()


def pairs_of(num_skills: int, trials: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return first and second skill of every trial, (S (S - 1) trials,) each."""
    first, second = torch.meshgrid(
        torch.arange(num_skills), torch.arange(num_skills), indexing="ij"
    )
    off_diagonal = first != second
    return (
        first[off_diagonal].repeat_interleave(trials),
        second[off_diagonal].repeat_interleave(trials),
    )


@torch.no_grad()
def evaluate_transitions(env: SkillEnv, policy: Policy, trials: int, command: float) -> Transitions:
    """Switch every pair of skills while walking straight ahead.

    Args:
        env: Of S (S - 1) * trials worlds.
        policy: Observation -> mean actions.
        trials: Of each pair.
        command: v_x, m/s.

    Raises:
        ValueError: The environment has another number of worlds.
    """
    count = len(env.skills)
    if env.num_envs != count * (count - 1) * trials:
        raise ValueError(f"{count * (count - 1) * trials} worlds needed, {env.num_envs} given")
    first, second = (x.to(env.device) for x in pairs_of(count, trials))
    commands = torch.zeros(env.num_envs, 3, device=env.device)
    commands[:, 0] = command
    switch = round(BEFORE / env.step_dt)
    motion = _record(env, policy, first, second, commands, switch)
    height = moving_average(motion.height, env.step_dt)
    pitch = moving_average(motion.pitch, env.step_dt)
    began = _within(env, first, height[switch - 1 : switch], pitch[switch - 1 : switch])[0]
    time = settle_times(_within(env, second, height[switch:], pitch[switch:]), env.step_dt)
    time = torch.where(began, time, torch.inf)
    settled = motion.alive & (time <= LIMIT)
    late, near = slice(switch, switch + round(LIMIT / env.step_dt)), round(NEAR / env.step_dt)
    measures = {
        "height_overshoot": overshoot(
            height[switch:], env.keyframe_height[first], env.keyframe_height[second]
        ),
        "pitch_overshoot": overshoot(
            pitch[switch:], env.keyframe_pitch[first], env.keyframe_pitch[second]
        ),
        "velocity_error": (motion.velocity[late, :, 0] - command).abs().mean(dim=0),
        "jerk": roughness(motion.velocity.diff(n=2, dim=0), switch - 2, near),
        "action_rate": roughness(motion.action.diff(dim=0), switch - 1, near),
    }

    def mean(values: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        total = torch.zeros(count, count, device=env.device)
        amount = total.clone()
        total.index_put_((first, second), torch.where(weight > 0, values, 0.0), accumulate=True)
        amount.index_put_((first, second), weight, accumulate=True)
        return (total / amount).cpu()

    alive = motion.alive.float()
    return Transitions(
        fell=mean(1.0 - alive, torch.ones_like(alive)),
        settled=mean(settled.float(), torch.ones_like(alive)),
        settle_time=mean(time, settled.float()),
        trials=trials,
        **{name: mean(values, alive) for name, values in measures.items()},
    )


@dataclass(frozen=True)
class _Motion:
    """What N robots did in T steps; see Measurements for frames and units."""

    height: torch.Tensor  # (T, N)
    pitch: torch.Tensor  # (T, N)
    velocity: torch.Tensor  # (T, N, 3)
    action: torch.Tensor  # (T, N, J)
    alive: torch.Tensor  # (N,): never fell


def _record(
    env: SkillEnv,
    policy: Policy,
    first: torch.Tensor,
    second: torch.Tensor,
    commands: torch.Tensor,
    switch: int,
) -> _Motion:
    """Walk in the skills `first` (N,), and from step `switch` on in the skills `second`."""
    env.seed(SEED)
    obs = env.reset(first, commands)
    alive = torch.ones(env.num_envs, dtype=torch.bool, device=env.device)
    steps = []
    for step in range(switch + round(AFTER / env.step_dt)):
        if step == switch:
            obs = env.set_task(second, commands)
        action = policy(obs)
        obs = env.step(action)[0]
        now = env.measure()
        alive = alive & ~now.fallen
        steps.append((now.base_height, now.pitch, now.lin_vel_h, action))
    return _Motion(*(torch.stack(x) for x in zip(*steps, strict=True)), alive=alive)


def overshoot(signal: torch.Tensor, start: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
    """Return how far signals (T, N) go beyond `goal` (N,), seen from `start` (N,); at least 0."""
    return ((signal - goal) * (goal - start).sign()).amax(dim=0).clamp(min=0.0)


def roughness(changes: torch.Tensor, switch: int, near: int) -> torch.Tensor:
    """Return the largest norm of (T, N, k) in `near` steps from `switch` over that before, (N,)."""
    size = torch.linalg.vector_norm(changes, dim=-1)
    before = size[switch - near : switch].amax(dim=0)
    return size[switch : switch + near].amax(dim=0) / before.clamp(min=1e-6)


def _within(
    env: SkillEnv, skill: torch.Tensor, height: torch.Tensor, pitch: torch.Tensor
) -> torch.Tensor:
    """Return whether heights and pitches (T, N) lie in the bands around the keyframes, (T, N)."""
    near = (height - env.keyframe_height[skill]).abs() < HEIGHT_BAND
    return near & ((pitch - env.keyframe_pitch[skill]).abs() < PITCH_BAND)


def settle_times(within: torch.Tensor, step_dt: float) -> torch.Tensor:
    """Return when each trial first stays within the bands for HOLD, (N,), s; infinity for never.

    Args:
        within: Whether both bands hold, (T, N) bool.
        step_dt: s.
    """
    hold = round(HOLD / step_dt)
    held = within.unfold(0, hold, 1).all(dim=-1)  # (T - hold + 1, N), by the first step
    first = held.float().argmax(dim=0) * step_dt
    return torch.where(held.any(dim=0), first, torch.inf)


@torch.no_grad()
def trace_skills(
    env: SkillEnv, policy: Policy, skills: list[int], hold: float, command: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Walk through a list of skills, `hold` seconds each.

    Returns:
        Base height, m, and pitch, rad, of each step and robot that never fell, (T, N) each.
    """
    commands = torch.zeros(env.num_envs, 3, device=env.device)
    commands[:, 0] = command
    env.seed(SEED)
    now = torch.full((env.num_envs,), skills[0], device=env.device)
    obs = env.reset(now, commands)
    alive = torch.ones(env.num_envs, dtype=torch.bool, device=env.device)
    heights, pitches = [], []
    for skill in skills:
        obs = env.set_task(torch.full_like(now, skill), commands)
        for _ in range(round(hold / env.step_dt)):
            obs = env.step(policy(obs))[0]
            step = env.measure()
            alive = alive & ~step.fallen
            heights.append(step.base_height)
            pitches.append(step.pitch)
    return torch.stack(heights)[:, alive].cpu(), torch.stack(pitches)[:, alive].cpu()
