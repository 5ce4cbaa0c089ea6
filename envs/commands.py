"""What the robots are asked to do: velocity commands and skills."""

from __future__ import annotations

from dataclasses import replace

import torch

from kiras_rl.envs import rotations
from kiras_rl.envs.randomness import UniformBuffer, scale_to
from kiras_rl.envs.state import Task
from kiras_rl.schema import CommandConfig, SkillConfig

COLUMNS = {
    "command": 3,
    "command_zero": 1,
    "command_resample": 1,
    "skill": 1,
    "skill_switch": 1,
    "start": 2,
    "heading": 1,
}
"""Random numbers that this module takes each step."""


class TaskSampler:
    """Draws commands, skills and start keyframes; written branch-free over the whole batch."""

    def __init__(
        self,
        commands: CommandConfig,
        skills: SkillConfig,
        num_skills: int,
        random: UniformBuffer,
        device: torch.device,
    ) -> None:
        """Begin with uniform skill probabilities."""
        self._commands = commands
        self._skills = skills
        self._num_skills = num_skills
        self._random = random
        ranges = [commands.lin_vel_x, commands.lin_vel_y, commands.ang_vel_z]
        self._low = torch.tensor([r[0] for r in ranges], device=device)
        self._high = torch.tensor([r[1] for r in ranges], device=device)
        self.probabilities = torch.full((num_skills,), 1.0 / num_skills, device=device)

    def advance(self, task: Task, reset: torch.Tensor) -> Task:
        """Return the tasks of the next step.

        Commands and skills change at a reset and, now and then, within an episode.

        Args:
            task: Tasks of this step.
            reset: Worlds that begin an episode, (N,) bool.
        """
        resample = self._chance("command_resample", self._commands.resample_probability)
        switch = self._chance("skill_switch", self._skills.switch_probability)
        renewed = reset | resample
        command = torch.where(renewed[:, None], self.draw_command(), task.command)
        heading = torch.where(renewed, self._draw_heading(command), task.heading)
        skill = torch.where(reset | switch, self.draw_skill(), task.skill)
        before = torch.where(switch, task.skill, task.start)
        start = torch.where(reset, self.draw_start(skill), before)
        return Task(command=command, skill=skill, start=start, heading=heading)

    def steer(self, task: Task, yaw: torch.Tensor) -> Task:
        """Return the tasks with the yaw rates that hold their headings.

        Args:
            task: Tasks; some hold a heading.
            yaw: Headings now, (N,), rad.
        """
        heading = torch.where(task.heading.isinf(), yaw, task.heading)
        rate = self._commands.heading_gain * rotations.wrap(heading - yaw)
        rate = rate.clamp(self._low[2], self._high[2])
        command = task.command.clone()
        command[:, 2] = torch.where(heading.isnan(), command[:, 2], rate)
        return replace(task, command=command, heading=heading)

    def _draw_heading(self, command: torch.Tensor) -> torch.Tensor:
        """Return +inf, the heading of the moment, for some of the moving worlds, else NaN."""
        holds = self._chance("heading", self._commands.heading_probability)
        return torch.where(holds & command.any(dim=1), torch.inf, torch.nan)

    def draw_command(self) -> torch.Tensor:
        """Return new commands, (N, 3)."""
        command = self._low + (self._high - self._low) * self._random["command"]
        forward, least = command[:, 0], self._commands.least_lin_vel_x
        command[:, 0] = forward.abs().clamp(min=least).copysign(forward)
        zero = self._chance("command_zero", self._commands.zero_probability)
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
        return torch.where(uniform[:, 0] < self._skills.start_at_target, skill, other)

    def _chance(self, column: str, probability: float) -> torch.Tensor:
        return self._random[column][:, 0] < probability
