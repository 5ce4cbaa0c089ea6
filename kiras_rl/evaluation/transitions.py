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


@dataclass(frozen=True)
class Transitions:
    """Results of every ordered pair of skills, rows from, columns to; the diagonal is empty.

    Attributes:
        fell: Share of trials with a fall, (S, S).
        settled: Share of trials that were in the first skill before the switch, did not fall, and
            settled in the second within LIMIT, (S, S).
        settle_time: Mean time to settle of those that did, (S, S), s.
        trials: Trials of each pair.
    """

    fell: torch.Tensor
    settled: torch.Tensor
    settle_time: torch.Tensor
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
    env.seed(SEED)
    obs = env.reset(first, commands)
    alive = torch.ones(env.num_envs, dtype=torch.bool, device=env.device)
    switch = round(BEFORE / env.step_dt)
    heights, pitches = [], []
    for step in range(round((BEFORE + AFTER) / env.step_dt)):
        if step == switch:
            obs = env.set_task(second, commands)
        obs = env.step(policy(obs))[0]
        now = env.measure()
        alive &= ~now.fallen
        heights.append(now.base_height)
        pitches.append(now.pitch)
    height = moving_average(torch.stack(heights), env.step_dt)
    pitch = moving_average(torch.stack(pitches), env.step_dt)
    began = _within(env, first, height[switch - 1 : switch], pitch[switch - 1 : switch])[0]
    time = settle_times(_within(env, second, height[switch:], pitch[switch:]), env.step_dt)
    time = torch.where(began, time, torch.inf)
    return _collect(first.cpu(), second.cpu(), alive.cpu(), time.cpu(), count, trials)


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


def _collect(
    first: torch.Tensor,
    second: torch.Tensor,
    alive: torch.Tensor,
    time: torch.Tensor,
    count: int,
    trials: int,
) -> Transitions:
    settled = alive & (time <= LIMIT)

    def mean(values: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        total, amount = torch.zeros(count, count), torch.zeros(count, count)
        total.index_put_((first, second), values * weight, accumulate=True)
        amount.index_put_((first, second), weight, accumulate=True)
        return total / amount

    ones = torch.ones_like(time)
    known = torch.where(settled, time, 0.0)
    return Transitions(
        fell=mean((~alive).float(), ones),
        settled=mean(settled.float(), ones),
        settle_time=mean(known, settled.float()),
        trials=trials,
    )
