"""What the robots are asked to do: velocity commands, skills, and other commands.

Another command is a function of `Asking` in `env.commands.terms`. It says by `commanding` how many
numbers it asks for and how many random ones it takes, and returns in every step what it asks for.
Rewards and observations find that in `task.terms["name"]`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch

from kiras_rl.config import ConfigError
from kiras_rl.envs import rotations
from kiras_rl.envs.lookup import find_terms
from kiras_rl.envs.randomness import Drawing, UniformBuffer, scale_to
from kiras_rl.envs.shapes import evaluate
from kiras_rl.envs.state import Asked, Task
from kiras_rl.schema import CommandConfig, RoughTaskConfig, SkillConfig

COLUMNS = {
    "command": 3,
    "command_zero": 1,
    "command_resample": 1,
    "skill": 1,
    "skill_switch": 1,
    "start": 2,
    "heading": 1,
}
"""Random numbers that this module takes each step, beside those of terms."""

TERMS = "command"  # group of the random numbers that terms take
_WHERE = "env.commands.terms"


@dataclass
class Asking(Drawing):
    """What a command may look at.

    Attributes:
        before: What it asked for in the step before, (N, width); zero in the very first.
        renewed: Worlds whose commands are drawn anew, (N,) bool: at a reset, and now and then.
        task: The velocities and skills of the next step.
        dt: Duration of a control step, s.
    """

    before: torch.Tensor
    renewed: torch.Tensor
    task: Task
    dt: float


def commanding(width: int, numbers: int = 0) -> Callable[[Callable], Callable]:
    """Mark a command of `width` numbers a world that takes so many random ones."""

    def mark(term: Callable) -> Callable:
        term.width, term.numbers = width, numbers
        return term

    return mark


@commanding(width=2, numbers=2)
def clock(asking: Asking, frequency: tuple[float, float]) -> torch.Tensor:
    """Ask for a rhythm: how far its turn is, in [0, 1), and its frequency, (N, 2), 1 and Hz."""
    phase, rate = asking.before.split(1, dim=1)
    later = torch.cat([(phase + asking.dt * rate) % 1.0, rate], dim=1)
    drawn = torch.cat([asking.uniform[:, :1], asking.between(frequency)[:, 1:]], dim=1)
    return torch.where(asking.renewed[:, None], drawn, later)


@commanding(width=1, numbers=1)
def number(asking: Asking, limits: tuple[float, float]) -> torch.Tensor:
    """Ask for a number within limits, (N, 1), which stays until commands are drawn anew."""
    return torch.where(asking.renewed[:, None], asking.between(limits), asking.before)


def find_commands(terms: Mapping[str, Any]) -> dict[str, partial[Any]]:
    """Return the commands of a configuration by name.

    Raises:
        ConfigError: Unknown command or parameter, or a function that is not marked by `commanding`.
    """
    found = find_terms(globals(), terms, Asking, _WHERE)
    for name, term in found.items():
        if not hasattr(term.func, "width"):
            raise ConfigError(
                f"{_WHERE}.{name}: '{term.func.__name__}' does not say how many numbers it asks "
                "for: mark it, as in @commanding(width=2, numbers=1)"
            )
    return found


class TaskSampler:
    """Draws commands, skills and start keyframes; written branch-free over the whole batch."""

    def __init__(
        self,
        commands: CommandConfig,
        skills: SkillConfig,
        num_skills: int,
        random: UniformBuffer,
        is_rough: torch.Tensor,
        on_rough: RoughTaskConfig | None = None,
        terms: Mapping[str, partial[Any]] | None = None,
        step_dt: float = 0.0,
    ) -> None:
        """Begin with uniform skill probabilities.

        Args:
            commands: Velocity commands.
            skills: How skills change.
            num_skills: S.
            random: Numbers of each step.
            is_rough: Worlds whose ground is rough, (N,) bool.
            on_rough: What is different there; None for nothing.
            terms: Other commands, of `find_commands`.
            step_dt: Duration of a control step, s.
        """
        self._terms, self._step_dt = terms or {}, step_dt
        device = is_rough.device
        self._num_skills = num_skills
        self._random = random
        self._heading_gain = commands.heading_gain

        def of_world(flat: float, rough: float | None) -> torch.Tensor:
            value = torch.full_like(is_rough, flat, dtype=torch.float32)
            return value if rough is None else torch.where(is_rough, rough, value)

        rough = vars(on_rough) if on_rough else {}
        forward = rough.get("lin_vel_x", commands.lin_vel_x)
        ranges = [commands.lin_vel_x, commands.lin_vel_y, commands.ang_vel_z]
        self._low, self._high = torch.tensor(ranges, device=device).unbind(1)
        self._forward_low = of_world(commands.lin_vel_x[0], forward[0])
        self._forward_high = of_world(commands.lin_vel_x[1], forward[1])
        self._zero = of_world(commands.zero_probability, rough.get("zero_probability"))
        self._resample = of_world(commands.resample_probability, rough.get("resample_probability"))
        self._holds = of_world(0.0, rough.get("heading_probability"))
        self._switch = of_world(skills.switch_probability, rough.get("switch_probability"))
        self._start_at_target = of_world(skills.start_at_target, rough.get("start_at_target"))
        self.probabilities = torch.full((num_skills,), 1.0 / num_skills, device=device)

    def advance(self, task: Task, reset: torch.Tensor) -> Task:
        """Return the tasks of the next step.

        Commands and skills change at a reset and, now and then, within an episode.

        Args:
            task: Tasks of this step.
            reset: Worlds that begin an episode, (N,) bool.
        """
        resample = self._chance("command_resample", self._resample)
        switch = self._chance("skill_switch", self._switch)
        renewed = reset | resample
        command = torch.where(renewed[:, None], self.draw_command(), task.command)
        heading = torch.where(renewed, self._draw_heading(command), task.heading)
        skill = torch.where(reset | switch, self.draw_skill(), task.skill)
        before = torch.where(switch, task.skill, task.start)
        start = torch.where(reset, self.draw_start(skill), before)
        asked = Task(command, skill, start, heading, task.terms)
        return self.go_on(asked, renewed)

    def go_on(self, task: Task, renewed: torch.Tensor) -> Task:
        """Return the tasks with what other commands ask for in the next step.

        Args:
            task: Tasks whose other commands are those of this step.
            renewed: Worlds whose commands are drawn anew, (N,) bool.
        """
        if not self._terms:
            return task
        asked = {name: self._ask(name, term, task, renewed) for name, term in self._terms.items()}
        return replace(task, terms=Asked(**asked))

    def _ask(
        self, name: str, term: partial[Any], task: Task, renewed: torch.Tensor
    ) -> torch.Tensor:
        uniform, before = self._random[f"{TERMS}/{name}"], task.terms[name]
        where = f"{_WHERE}.{name}"
        asking = Asking(uniform, where, before, renewed, task, self._step_dt)
        return evaluate(term, asking, where, tuple(before.shape))

    def steer(self, task: Task, yaw: torch.Tensor) -> Task:
        """Return the tasks with the yaw rates that hold their headings.

        Args:
            task: Tasks; some hold a heading.
            yaw: Headings now, (N,), rad.
        """
        heading = torch.where(task.heading.isinf(), yaw, task.heading)
        rate = self._heading_gain * rotations.wrap(heading - yaw)
        rate = rate.clamp(self._low[2], self._high[2])
        command = task.command.clone()
        command[:, 2] = torch.where(heading.isnan(), command[:, 2], rate)
        return replace(task, command=command, heading=heading)

    def _draw_heading(self, command: torch.Tensor) -> torch.Tensor:
        """Return +inf, the heading of the moment, for some of the moving worlds, else NaN."""
        holds = self._chance("heading", self._holds)
        return torch.where(holds & command.any(dim=1), torch.inf, torch.nan)

    def draw_command(self) -> torch.Tensor:
        """Return new commands, (N, 3)."""
        uniform = self._random["command"]
        command = self._low + (self._high - self._low) * uniform
        span = self._forward_high - self._forward_low
        command[:, 0] = self._forward_low + span * uniform[:, 0]
        zero = self._chance("command_zero", self._zero)
        return command * (~zero)[:, None]

    def draw_skill(self) -> torch.Tensor:
        """Return new skills by the current probabilities, (N,) int64."""
        edges = self.probabilities.cumsum(0)
        drawn = torch.searchsorted(edges, self._random["skill"][:, 0].contiguous(), right=True)
        return drawn.clamp(max=self._num_skills - 1)

    def draw_start(self, skill: torch.Tensor) -> torch.Tensor:
        """Return start keyframes: the target's own, or any other with equal chances, (N,)."""
        uniform = self._random["start"]
        offset = scale_to(uniform[:, 1], 1.0, float(self._num_skills)).long()
        other = (skill + offset) % self._num_skills
        return torch.where(uniform[:, 0] < self._start_at_target, skill, other)

    def _chance(self, column: str, probability: torch.Tensor) -> torch.Tensor:
        return self._random[column][:, 0] < probability
