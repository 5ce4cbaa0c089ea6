"""The observation of every step: groups, sensor noise, and the history of what was observed."""

from __future__ import annotations

from dataclasses import replace

import torch
from tensordict import TensorDict

from kiras_rl import interfaces as names
from kiras_rl.envs.observations import ObservationGroup, View
from kiras_rl.envs.randomness import UniformBuffer, scale_to
from kiras_rl.envs.sensing import Sensors
from kiras_rl.schema import ObservationConfig

NOISE = "noise"  # column of the random numbers


class Observer:
    """Turns views of the robots into the groups of kiras_rl.interfaces.

    Letters: N worlds, P proprioceptive numbers, H frames of history, D imitation features.

    Attributes:
        proprio: What the robot knows.
        critic: What the critic sees besides the noise-free proprio part.
        imitation: Phi.
        clean: Proprio part of the last observation without errors of sensors, (N, P).
        features: Phi of the last observation, (N, D).
        observation: The last observation.
        noise: Share of the noise that observations have, ().
    """

    def __init__(self, config: ObservationConfig, view: View) -> None:
        """Build the groups; sizes follow from a first view."""
        self._config = config
        self.proprio = ObservationGroup("proprio", config.proprio, view)
        self.critic = ObservationGroup("critic", config.critic, view)
        self.imitation = ObservationGroup("imitation", config.imitation, view)
        self.clean, self.features = self.proprio(view), self.imitation(view)
        self.noise = torch.ones((), device=self.clean.device)
        self._frame = self.clean
        self._history = self._frame[:, None].repeat(1, config.history_length, 1)  # (N, H, P)
        self.observation = TensorDict()

    @property
    def tells_physics(self) -> bool:
        """Whether a group tells what was randomized: what no term reads is not kept."""
        return any(g.tells_physics for g in (self.proprio, self.critic, self.imitation))

    def observe(
        self, view: View, sensors: Sensors, begun: torch.Tensor, random: UniformBuffer
    ) -> TensorDict:
        """Return the observation; worlds that have just `begun` (N,) get copies as history.

        Args:
            view: Of the robots as they are.
            sensors: Through which the robots see it.
            begun: See above.
            random: For the noise.
        """
        self.clean, self.features = self.proprio(view), self.imitation(view)
        read = self.clean
        if not sensors.are_exact:
            read = self.proprio(replace(view, sensed=sensors.read(view.robot, begun)))
        frame = self._with_noise(read, random)
        shifted = torch.cat([self._history[:, 1:], self._frame[:, None]], dim=1)
        self._history = torch.where(begun[:, None, None], frame[:, None], shifted)
        self._frame = frame
        return self._assemble(view)

    def change_task(self, view: View) -> TensorDict:
        """Return the last observation with the task of `view`: same robots, same noise."""
        clean = self.proprio(view)
        self._frame = self._frame + clean - self.clean
        self.clean, self.features = clean, self.imitation(view)
        return self._assemble(view)

    def privileged(self, view: View) -> torch.Tensor:
        """Return what the critic sees of any view, (rows, C)."""
        return torch.cat([self.proprio(view), self.critic(view)], dim=1)

    def name_term(self, group: str, column: int) -> str | None:
        """Return the YAML key of what a column of a group comes from, None if it has none."""
        parts = {
            names.PROPRIO: (self.proprio,),
            names.HISTORY: (self.proprio,) * self._config.history_length,
            names.CRITIC: (self.proprio, self.critic),
            names.IMITATION: (self.imitation,),
        }
        for part in parts.get(group, ()):
            for name, size in zip(part.names, part.sizes, strict=True):
                if column < size:
                    return f"{part.where}.{name}"
                column -= size
        return None

    def _assemble(self, view: View) -> TensorDict:
        """Collect the groups in new tensors: the learner keeps them while the physics goes on."""
        task = view.task
        groups = {
            names.PROPRIO: self._frame,
            names.HISTORY: self._history.flatten(1),
            names.CRITIC: torch.cat([self.clean, self.critic(view)], dim=1),
            names.IMITATION: self.features,
            names.VELOCITY: view.robot.base_lin_vel_b,
            names.SKILL: view.keyframes.code[task.skill],
            names.COMMAND: task.command,
        }
        self.observation = TensorDict(
            groups, batch_size=[len(self._frame)], device=self._frame.device
        )
        return self.observation

    def _with_noise(self, read: torch.Tensor, random: UniformBuffer) -> torch.Tensor:
        if not self._config.noise:
            return read
        return read + self.noise * self.proprio.noise * scale_to(random[NOISE], -1.0, 1.0)

    def state_dict(self) -> dict:
        """Return all that the next observation depends on."""
        return {
            "clean": self.clean,
            "features": self.features,
            "frame": self._frame,
            "history": self._history.flatten(1),
            "observation": self.observation.to_dict(),
        }

    def load_state_dict(self, state: dict) -> None:
        """Go on from a saved state."""
        device = self.clean.device
        self.clean, self.features = state["clean"].to(device), state["features"].to(device)
        self._frame = state["frame"].to(device)
        self._history = state["history"].to(device).view_as(self._history)
        self.observation = TensorDict(
            state["observation"], batch_size=[len(self.clean)], device=device
        )
