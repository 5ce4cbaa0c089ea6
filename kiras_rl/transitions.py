"""How well a policy changes from one skill to another while walking."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from kiras_rl.evaluation import SEED, Policy
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
        settled: Share of trials without a fall that settled within LIMIT, (S, S).
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
    within = []
    for step in range(round((BEFORE + AFTER) / env.step_dt)):
        if step == round(BEFORE / env.step_dt):
            obs = env.set_task(second, commands)
        obs = env.step(policy(obs))[0]
        now = env.measure()
        alive &= ~now.fallen
        height_error = (now.base_height - env.keyframe_height[second]).abs()
        pitch_error = (now.pitch - env.keyframe_pitch[second]).abs()
        within.append((height_error < HEIGHT_BAND) & (pitch_error < PITCH_BAND))
    after = torch.stack(within[round(BEFORE / env.step_dt) :])
    time = settle_times(after, env.step_dt)
    return _collect(first.cpu(), second.cpu(), alive.cpu(), time.cpu(), count, trials)


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
