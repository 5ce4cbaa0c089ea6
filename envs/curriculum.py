"""Which ground a world shows: its terrain type for good, its level by how its robot fares."""

from __future__ import annotations

import torch

from kiras_rl.envs.randomness import UniformBuffer, scale_to
from kiras_rl.envs.state import RobotState, Task
from kiras_rl.envs.terrain_library import TerrainLibrary

COLUMNS = {"terrain": 2}
"""Random numbers that this module takes each step."""

LOST_SHARE = 0.5  # of the commanded way; a robot that made less of it is stuck
LEAST_WAY = 1.0  # m commanded before a robot can count as stuck
MEMORY = 0.999  # of the shares of success, a step: about 20 s


class Curriculum:
    """The levels of N worlds, for each of S skills one of its own.

    An easy skill would otherwise pull a hard one to ground where it learns nothing. A world is
    promoted when its robot crosses the tile, and demoted when it falls or goes less than half of
    the way that was commanded until then; one that was told to stand has no way to go. At the top
    a promotion draws any level, so that easy ground is not forgotten. Episodes in which the skill
    changed do not count: it is not clear for whom they would.

    Attributes:
        kind: Terrain type of each world, (N,).
        is_flat: Worlds of the type that is flat, (N,) bool.
        level: Difficulty, (N, S).
    """

    def __init__(
        self, library: TerrainLibrary, num_skills: int, random: UniformBuffer, start_level: int
    ) -> None:
        """Deal the types to the worlds by their proportions, and levels up to `start_level`."""
        self._library, self._random = library, random
        n, device = len(random["terrain"]), random["terrain"].device
        edges = torch.tensor(library.proportions, device=device).cumsum(0)
        middle = (torch.arange(n, device=device) + 0.5) / n
        self.kind = torch.searchsorted(edges, middle.double()).clamp(max=len(library.types) - 1)
        flat = library.types.index("flat") if "flat" in library.types else -1
        self.is_flat = self.kind == flat
        of_type = self.kind == torch.arange(len(library.types), device=device)[:, None]
        groups = torch.cat([of_type, ~self.is_flat[None]]).float()  # (types + 1, N)
        self._mean_of = groups / groups.sum(1, keepdim=True).clamp(min=1.0)
        drawn = torch.rand(n, num_skills, generator=random.generator, device=device)
        self.level = (drawn * (min(start_level, library.levels - 1) + 1)).long()
        self._way = torch.zeros(n, device=device)
        self._gone = torch.zeros(n, device=device)
        self._pure = torch.ones(n, dtype=torch.bool, device=device)
        self._tries = torch.zeros(library.levels, device=device)
        self._crossings = torch.zeros(library.levels, device=device)

    def record(self, task: Task, robot: RobotState, dt: float) -> None:
        """Add a step's commanded and made way, both along the command."""
        command = task.command[:, :2]
        speed = torch.linalg.vector_norm(command, dim=1)
        made = (robot.base_lin_vel_h[:, :2] * command).sum(1) / speed.clamp(min=1e-6)
        self._way += speed * dt
        self._gone += made * dt

    def keep_counting(self, worlds: torch.Tensor) -> None:
        """Let only the running episodes of some worlds, (N,) bool, move a level.

        In the others the skill changed, or physics broke or ran out of memory.
        """
        self._pure &= worlds

    def update(
        self, done: torch.Tensor, fallen: torch.Tensor, crossed: torch.Tensor, skill: torch.Tensor
    ) -> None:
        """Move the levels of the episodes that ended.

        Args:
            done: Worlds whose episode ended, (N,) bool.
            fallen: By a fall.
            crossed: Far enough from the middle.
            skill: Of the episode, (N,).
        """
        stuck = (self._way > LEAST_WAY) & (self._gone < LOST_SHARE * self._way)
        up = done & self._pure & crossed & ~fallen
        down = done & self._pure & ~up & (fallen | stuck)
        level = self.level.gather(1, skill[:, None])[:, 0]
        self._count(level, up, tried=up | down | (done & self._pure & (self._way > LEAST_WAY)))
        level = level + up.long() - down.long()
        top = self._library.levels
        anywhere = scale_to(self._random["terrain"][:, 0], 0.0, float(top)).long()
        level = torch.where(level >= top, anywhere, level).clamp(min=0)
        self.level.scatter_(1, skill[:, None], level[:, None])
        self._way.masked_fill_(done, 0.0)
        self._gone.masked_fill_(done, 0.0)
        self._pure |= done

    def _count(self, level: torch.Tensor, crossed: torch.Tensor, tried: torch.Tensor) -> None:
        """Add the rough episodes that ended to the shares of success at each level."""
        rough = (~self.is_flat).float()
        self._tries = (MEMORY * self._tries).index_add(0, level, tried * rough)
        self._crossings = (MEMORY * self._crossings).index_add(0, level, crossed * rough)

    def tiles(self, skill: torch.Tensor) -> torch.Tensor:
        """Return a tile of each world's type and of its level in `skill`, (N,)."""
        variants = self._library.variants
        variant = scale_to(self._random["terrain"][:, 1], 0.0, float(variants)).long()
        level = self.level.gather(1, skill[:, None])[:, 0]
        return self._library.index(self.kind, level, variant)

    def describe(self, skills: tuple[str, ...]) -> dict[str, torch.Tensor]:
        """Return by log name mean levels of types and skills, and shares of success by level."""
        means = self._mean_of @ self.level.float()  # of each type and of all rough ones, by skill
        by_type, by_skill = means[:-1].mean(1).unbind(), means[-1].unbind()
        log = {
            f"Terrain/level_{name}": mean
            for names, values in ((self._library.types, by_type), (skills, by_skill))
            for name, mean in zip(names, values, strict=True)
        }
        shares = (self._crossings / self._tries.clamp(min=1.0)).unbind()
        return log | {f"Terrain/success_level_{k}": share for k, share in enumerate(shares)}

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return levels and the way of the running episodes."""
        return {name: getattr(self, name) for name in _STATE}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Go on from a saved state."""
        for name in _STATE:
            setattr(self, name, state[name].to(self.level.device))


_STATE = ("level", "_way", "_gone", "_pure", "_tries", "_crossings")
