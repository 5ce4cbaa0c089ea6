"""How often each skill crosses each terrain, without action noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from kiras_rl.evaluation.flat import FLOOR, SEED, Policy, mean_where, posture_errors
from kiras_rl.evaluation.stance import Stance
from kiras_rl.interfaces import SkillEnv

RADIUS = 3.0  # m from the middle of the tile, beyond all but the last obstacles: crossed
TIME_LIMIT = 20.0  # s
PATIENCE = 2.0  # times the duration of the way at the commanded speed
LIMB_SHARE = 0.05  # of the steps with a thigh or shank on the ground, at most, to succeed strictly
LOAD_SHARE = 0.1  # of all impulse from the ground on trunk, thighs and shanks, at most: feet only


@dataclass(frozen=True)
class Obstacle:
    """A tile that robots try to cross.

    Attributes:
        terrain: Name of its type.
        level: Of difficulty in the environment.
        variant: Which of its tiles; None for all in turn.
    """

    terrain: str
    level: int
    variant: int | None = None


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
    """How the trials ended, bool of one shape each.

    Attributes:
        success: Went RADIUS far within PATIENCE times the duration of the way and TIME_LIMIT.
        feet_only: And did so with at most LOAD_SHARE of the ground's impulse on anything but feet.
        strict: And did so with thighs or shanks on the ground in at most LIMB_SHARE of the steps.
        kept: Succeeded, and kept the skill's keyframe on the way: mean errors of the moving
            averages of height and pitch over its Stance are at most those of FLOOR.
        fell: Fell before either.
    """

    success: torch.Tensor
    feet_only: torch.Tensor
    strict: torch.Tensor
    kept: torch.Tensor
    fell: torch.Tensor


@torch.no_grad()
def run_trials(env: SkillEnv, policy: Policy, trials: Trials, seed: int = SEED) -> Outcomes:
    """Start every robot in the middle of its tile, in its skill's keyframe, with any heading.

    Args:
        env: With one world a trial.
        policy: Observation -> mean actions.
        trials: What to try.
        seed: Of robots and headings.

    Returns:
        Outcomes of shape (N,).
    """
    command = torch.zeros(env.num_envs, 3, device=env.device)
    command[:, 0] = trials.speed
    env.seed(seed)
    env.place(trials.terrain, trials.level, trials.variant)
    obs = env.reset(trials.skill, command, hold_heading=True)
    limit = (PATIENCE * RADIUS / trials.speed).clamp(max=TIME_LIMIT) / env.step_dt
    success = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
    fell = success.clone()
    steps, limb_steps, load, limb_load = (torch.zeros_like(limit) for _ in range(4))
    stance, postures = Stance(env, trials.skill), []
    for step in range(int(limit.max().ceil())):
        obs = env.step(policy(obs))[0]
        now = env.measure()
        running = ~success & ~fell & (step < limit)
        postures.append((*stance.read(now), running))
        steps += running
        limb_steps += running & now.limb_contact
        limb_load += running * now.limb_load
        load += running * (now.limb_load + now.foot_load)
        fell |= running & now.fallen
        success |= running & ~now.fallen & (now.distance >= RADIUS)
        if step % 25 == 0 and not (~success & ~fell & (step < limit)).any():
            break
    return Outcomes(
        success=success,
        feet_only=success & (limb_load <= LOAD_SHARE * load),
        strict=success & (limb_steps <= LIMB_SHARE * steps),
        kept=success & _keeps(env, trials.skill, postures),
        fell=fell,
    )


def _keeps(
    env: SkillEnv, skill: torch.Tensor, postures: list[tuple[torch.Tensor, ...]]
) -> torch.Tensor:
    """Return who kept its keyframe, (N,) bool, from height, pitch and "running" of each step."""
    height, pitch, running = (torch.stack(x) for x in zip(*postures, strict=True))
    height_error, pitch_error = (
        mean_where(error, running.float()) for error in posture_errors(height, pitch, skill, env)
    )
    return (height_error <= FLOOR.height) & (pitch_error <= FLOOR.pitch)


@dataclass(frozen=True)
class TerrainResult:
    """Shares of successful trials, rows of terrain types, columns of skills.

    Attributes:
        terrains: Names of the types.
        skills: Names of the skills.
        level: Difficulty level of all trials.
        success: (terrains, S).
        feet_only: (terrains, S).
        strict: (terrains, S).
    """

    terrains: tuple[str, ...]
    skills: tuple[str, ...]
    level: int
    success: torch.Tensor
    feet_only: torch.Tensor
    strict: torch.Tensor

    def score(self) -> float:
        """Return 0 where every trial succeeds on feet only, 2 where none succeeds at all."""
        return 2.0 - (self.success + self.feet_only).mean().item()

    def as_scalars(self) -> dict[str, float]:
        """Return the shares by log name, for each type and for each skill."""
        scalars = {}
        for kind in ("success", "feet_only", "strict"):
            shares = getattr(self, kind)
            for name, value in zip(self.terrains, shares.mean(dim=1).tolist(), strict=True):
                scalars[f"Eval_terrain/{kind}_{name}"] = value
            for name, value in zip(self.skills, shares.mean(dim=0).tolist(), strict=True):
                scalars[f"Eval_{name}/terrain_{kind}"] = value
        return scalars


def rough_types(terrains: Sequence[str]) -> tuple[str, ...]:
    """Return the terrain types that are not flat."""
    return tuple(name for name in terrains if name != "flat")


def evaluate_terrain(
    env: SkillEnv, policy: Policy, robots: int, level: int, speeds: tuple[float, float]
) -> TerrainResult:
    """Try every skill on every rough terrain type.

    Args:
        env: Of rough types * S * robots worlds.
        policy: Observation -> mean actions.
        robots: Trials of each type and skill.
        level: Difficulty level.
        speeds: Lowest and highest commanded v_x, m/s.
    """
    types = rough_types(env.terrains)
    outcomes = cross(env, policy, [Obstacle(name, level) for name in types], robots, speeds)
    shares = {
        kind: getattr(outcomes, kind).float().mean(dim=-1).cpu()
        for kind in ("success", "feet_only", "strict")
    }
    return TerrainResult(types, env.skills, level, **shares)


def cross(
    env: SkillEnv,
    policy: Policy,
    obstacles: Sequence[Obstacle],
    robots: int,
    speeds: tuple[float, float],
    seed: int = SEED,
) -> Outcomes:
    """Try every skill on every obstacle, with any heading and speeds over the whole range.

    Args:
        env: Of K * S * robots worlds.
        policy: Observation -> mean actions.
        obstacles: K tiles.
        robots: Trials of each obstacle and skill.
        speeds: Lowest and highest commanded v_x, spread evenly over the trials of a cell, m/s.
        seed: Of robots and headings.

    Returns:
        Outcomes of shape (K, S, robots).
    """
    outcomes = run_trials(env, policy, _deal(env, obstacles, robots, speeds), seed)
    shape = (len(obstacles), len(env.skills), robots)
    return Outcomes(**{name: flags.view(shape) for name, flags in vars(outcomes).items()})


def _deal(
    env: SkillEnv, obstacles: Sequence[Obstacle], robots: int, speeds: tuple[float, float]
) -> Trials:
    """Deal the worlds to obstacles, then skills, then speeds."""
    count, cells = len(env.skills), len(obstacles)

    def of_each(values: list[int]) -> torch.Tensor:
        return torch.tensor(values, device=env.device).repeat_interleave(count * robots)

    # The middle of as many equal parts of the range as there are trials.
    parts = (torch.arange(robots, device=env.device) + 0.5) / robots
    speed = speeds[0] + (speeds[1] - speeds[0]) * parts
    variants = [o.variant for o in obstacles if o.variant is not None]
    return Trials(
        terrain=of_each([env.terrains.index(o.terrain) for o in obstacles]),
        level=of_each([o.level for o in obstacles]),
        skill=torch.arange(count, device=env.device).repeat_interleave(robots).repeat(cells),
        speed=speed.repeat(count * cells),
        variant=of_each(variants) if variants else None,
    )
