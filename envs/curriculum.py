"""Which ground a world shows: its terrain type for good, its level by what its skill can cross."""

from __future__ import annotations

import torch

from kiras_rl.envs.randomness import UniformBuffer, scale_to
from kiras_rl.envs.state import RobotState, Task
from kiras_rl.envs.terrain_library import TerrainLibrary

COLUMNS = {"terrain": 3}
"""Random numbers that this module takes each step."""

SHARES = (0.5, 0.35, 0.15)  # of the episodes: at the frontier, at any level up to it, at any at all
MASTERED = 0.75  # share of success with which a level is left behind
TRIALS = 20.0  # that a share of success remembers, about
ENOUGH = 8.0  # trials before a level can be left behind
LEAST_WAY = 1.0  # m commanded before a robot that made less of it can count as stuck
MADE_SHARE = 0.75  # of the commanded way, to succeed where the episode ended before the tile did
MADE_WAY = 2.0  # m of commanded way at least, for that


class Curriculum:
    """The levels of N worlds, of T terrain types and S skills.

    A level is left behind by a skill on a type of terrain when enough of the last trials there
    succeeded. The first level that was not is their frontier: half of the episodes begin there,
    the rest below or anywhere, so that easy ground is not forgotten and a chance success far above
    is seen. All worlds share what was found, so levels rise as fast as the policy can follow.

    A trial succeeds when its robot crosses the tile or makes most of the way that was commanded,
    and fails when it falls or makes too little; one that was told to stand is no trial. Nor is one
    in which the skill changed: it is not clear for whom it would count.

    Attributes:
        kind: Terrain type of each world, (N,).
        is_flat: Worlds of the type that is flat, (N,) bool.
        level: Difficulty of the running episode, (N,).
    """

    def __init__(self, library: TerrainLibrary, num_skills: int, random: UniformBuffer) -> None:
        """Deal the types to the worlds by their proportions; begin at the lowest level."""
        self._library, self._random = library, random
        n, device = len(random["terrain"]), random["terrain"].device
        edges = torch.tensor(library.proportions, device=device).cumsum(0)
        middle = (torch.arange(n, device=device) + 0.5) / n
        self.kind = torch.searchsorted(edges, middle.double()).clamp(max=len(library.types) - 1)
        flat = library.types.index("flat") if "flat" in library.types else -1
        self.is_flat = self.kind == flat
        trained = [k for k, share in enumerate(library.proportions) if share > 0 and k != flat]
        self._trained = torch.tensor(trained, dtype=torch.int64, device=device)  # rough types
        self._num_skills = num_skills
        self.level = torch.zeros_like(self.kind)
        self._way = torch.zeros(n, device=device)
        self._gone = torch.zeros(n, device=device)
        self._pure = torch.ones(n, dtype=torch.bool, device=device)
        shape = (len(library.types), num_skills, library.levels)
        self._tries = torch.zeros(shape, device=device)
        self._successes = torch.zeros(shape, device=device)

    @property
    def frontier(self) -> torch.Tensor:
        """The first level that was not left behind, the top level if all were, (T, S)."""
        mastered = (self._tries >= ENOUGH) & (self._successes >= MASTERED * self._tries)
        return mastered.long().cumprod(-1).sum(-1).clamp(max=self._library.levels - 1)

    def record(self, task: Task, robot: RobotState, dt: float) -> None:
        """Add a step's commanded and made way, both along the command."""
        command = task.command[:, :2]
        speed = torch.linalg.vector_norm(command, dim=1)
        made = (robot.base_lin_vel_h[:, :2] * command).sum(1) / speed.clamp(min=1e-6)
        self._way += speed * dt
        self._gone += made * dt

    def keep_counting(self, worlds: torch.Tensor) -> None:
        """Let only the running episodes of some worlds, (N,) bool, count as trials.

        In the others the skill changed, or physics broke or ran out of memory.
        """
        self._pure &= worlds

    def update(
        self, done: torch.Tensor, fallen: torch.Tensor, crossed: torch.Tensor, skill: torch.Tensor
    ) -> None:
        """Count the episodes that ended.

        Args:
            done: Worlds whose episode ended, (N,) bool.
            fallen: By a fall.
            crossed: Far enough from the middle.
            skill: Of the episode, (N,).
        """
        made = (self._way > MADE_WAY) & (self._gone >= MADE_SHARE * self._way)
        success = (crossed | made) & ~fallen
        tried = done & self._pure & (success | fallen | (self._way > LEAST_WAY))
        self._count(skill, success & tried, tried)
        self._way.masked_fill_(done, 0.0)
        self._gone.masked_fill_(done, 0.0)
        self._pure |= done

    def _count(self, skill: torch.Tensor, success: torch.Tensor, tried: torch.Tensor) -> None:
        """Let the counts of (N,) trials fade into those of new ones."""
        cell = (self.kind * self._num_skills + skill) * self._library.levels + self.level
        new = torch.zeros(2, self._tries.numel(), device=cell.device)
        new = new.index_add(1, cell, torch.stack([tried, success]).float())
        tries, successes = new.unflatten(1, self._tries.shape)
        kept = (1.0 - 1.0 / TRIALS) ** tries
        self._tries = kept * self._tries + tries
        self._successes = kept * self._successes + successes

    def begin(self, begun: torch.Tensor, skill: torch.Tensor) -> None:
        """Draw the level of the episodes that begin, (N,) bool, in the skills (N,)."""
        kind, within, _ = self._random["terrain"].unbind(1)
        frontier = self.frontier[self.kind, skill]
        below = scale_to(within, 0.0, (frontier + 1).float()).long()
        anywhere = scale_to(within, 0.0, float(self._library.levels)).long()
        drawn = torch.where(kind < SHARES[0] + SHARES[1], below, anywhere)
        drawn = torch.where(kind < SHARES[0], frontier, drawn)
        self.level = torch.where(begun, drawn, self.level)

    def tiles(self) -> torch.Tensor:
        """Return a tile of each world's type and level, (N,)."""
        variants = self._library.variants
        variant = scale_to(self._random["terrain"][:, 2], 0.0, float(variants)).long()
        return self._library.index(self.kind, self.level, variant)

    def describe(self, skills: tuple[str, ...]) -> dict[str, torch.Tensor]:
        """Return by log name mean frontiers of types and skills, and shares of success by level.

        Those of skills and levels are over the rough types that are trained on.
        """
        frontier = self.frontier.float()
        by_type, by_skill = frontier.mean(1).unbind(), frontier[self._trained].mean(0).unbind()
        log = {
            f"Terrain/level_{name}": mean
            for names, values in ((self._library.types, by_type), (skills, by_skill))
            for name, mean in zip(names, values, strict=True)
        }
        tries, successes = (x[self._trained].sum((0, 1)) for x in (self._tries, self._successes))
        shares = (successes / tries.clamp(min=1.0)).unbind()
        return log | {f"Terrain/success_level_{k}": share for k, share in enumerate(shares)}

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return levels, what was found, and the way of the running episodes."""
        return {name: getattr(self, name) for name in _STATE}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Go on from a saved state."""
        for name in _STATE:
            setattr(self, name, state[name].to(self.level.device))


_STATE = ("level", "_way", "_gone", "_pure", "_tries", "_successes")
