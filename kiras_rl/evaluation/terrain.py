"""How often each skill crosses each terrain, without action noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from kiras_rl.evaluation.flat import SEED, Policy
from kiras_rl.interfaces import SkillEnv

RADIUS = 3.0  # m from the middle of the tile, beyond all but the last obstacles: crossed
TIME_LIMIT = 20.0  # s
PATIENCE = 2.0  # times the duration of the way at the commanded speed
LIMB_SHARE = 0.05  # of the steps with a thigh or shank on the ground, at most, to succeed strictly


@dataclass(frozen=True)
class Trials:
    """One trial a world, (N,) each.

    Attributes:
        terrain: Index of the terrain type.
        level: Difficulty level.
        skill: Index of the skill.
        speed: Commanded v_x, m/s; the heading of the start is held.
        variant: Of the tile; None deals the variants to the worlds in turn.
    """

    terrain: torch.Tensor
    level: torch.Tensor
    skill: torch.Tensor
    speed: torch.Tensor
    variant: torch.Tensor | None = None


@dataclass(frozen=True)
class Outcomes:
    """How the trials ended, (N,) bool each.

    Attributes:
        success: Went RADIUS far within PATIENCE times the duration of the way and TIME_LIMIT.
        strict: And did so with thighs or shanks on the ground in at most LIMB_SHARE of the steps.
        fell: Fell before either.
    """

    success: torch.Tensor
    strict: torch.Tensor
    fell: torch.Tensor


@torch.no_grad()
def run_trials(env: SkillEnv, policy: Policy, trials: Trials, seed: int = SEED) -> Outcomes:
    """Start every robot in the middle of its tile, in its skill's keyframe, with any heading.

    Args:
        env: With one world a trial.
        policy: Observation -> mean actions.
        trials: What to try.
        seed: Of robots and headings.
    """
    command = torch.zeros(env.num_envs, 3, device=env.device)
    command[:, 0] = trials.speed
    env.seed(seed)
    env.place(trials.terrain, trials.level, trials.variant)
    obs = env.reset(trials.skill, command, hold_heading=True)
    limit = (PATIENCE * RADIUS / trials.speed).clamp(max=TIME_LIMIT) / env.step_dt
    success = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
    fell, limb_steps, steps = success.clone(), torch.zeros_like(limit), torch.zeros_like(limit)
    for step in range(int(limit.max().ceil())):
        obs = env.step(policy(obs))[0]
        now = env.measure()
        running = ~success & ~fell & (step < limit)
        steps += running
        limb_steps += running & now.limb_contact
        fell |= running & now.fallen
        success |= running & ~now.fallen & (now.distance >= RADIUS)
        if step % 25 == 0 and not (~success & ~fell & (step < limit)).any():
            break
    return Outcomes(success, success & (limb_steps <= LIMB_SHARE * steps), fell)


@dataclass(frozen=True)
class TerrainResult:
    """Shares of successful trials, rows of terrain types, columns of skills.

    Attributes:
        terrains: Names of the types.
        skills: Names of the skills.
        level: Difficulty level of all trials.
        success: (terrains, S).
        strict: (terrains, S).
    """

    terrains: tuple[str, ...]
    skills: tuple[str, ...]
    level: int
    success: torch.Tensor
    strict: torch.Tensor

    def score(self) -> float:
        """Return 0 where every trial succeeds strictly, 2 where none does."""
        return 2.0 * (1.0 - self.strict.mean().item())

    def as_scalars(self) -> dict[str, float]:
        """Return the shares by log name, for each type and for each skill."""
        scalars = {}
        for kind in ("success", "strict"):
            shares = getattr(self, kind)
            for name, value in zip(self.terrains, shares.mean(dim=1).tolist(), strict=True):
                scalars[f"Eval_terrain/{kind}_{name}"] = value
            for name, value in zip(self.skills, shares.mean(dim=0).tolist(), strict=True):
                scalars[f"Eval_{name}/terrain_{kind}"] = value
        return scalars


def rough_types(terrains: Sequence[str]) -> list[int]:
    """Return the indices of the terrain types that are not flat."""
    return [index for index, name in enumerate(terrains) if name != "flat"]


def evaluate_terrain(
    env: SkillEnv, policy: Policy, robots: int, level: int, speeds: tuple[float, float]
) -> TerrainResult:
    """Try every skill on every rough terrain type.

    Args:
        env: Of rough types * S * robots worlds.
        policy: Observation -> mean actions.
        robots: Trials of each type and skill.
        level: Difficulty level.
        speeds: Lowest and highest commanded v_x, spread evenly over the trials of a cell, m/s.
    """
    types, count = rough_types(env.terrains), len(env.skills)
    terrain = torch.tensor(types, device=env.device).repeat_interleave(count * robots)
    skill = torch.arange(count, device=env.device).repeat_interleave(robots).repeat(len(types))
    # The middle of as many equal parts of the range as there are trials.
    parts = (torch.arange(robots, device=env.device) + 0.5) / robots
    spread = speeds[0] + (speeds[1] - speeds[0]) * parts
    trials = Trials(
        terrain=terrain,
        level=torch.full_like(terrain, level),
        skill=skill,
        speed=spread.repeat(len(types) * count),
    )
    outcomes = run_trials(env, policy, trials)

    def shares(flags: torch.Tensor) -> torch.Tensor:
        return flags.float().view(len(types), count, robots).mean(dim=-1).cpu()

    return TerrainResult(
        terrains=tuple(env.terrains[index] for index in types),
        skills=env.skills,
        level=level,
        success=shares(outcomes.success),
        strict=shares(outcomes.strict),
    )
