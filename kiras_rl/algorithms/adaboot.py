"""AdaBoot: how far the estimator is trusted, from the spread of returns across worlds."""

from __future__ import annotations

import torch

from kiras_rl import distributed

MODES = ("gate_update", "bootstrap_input", "both", "off")
_MIN_WORLDS = 64  # with completed episodes, before their spread means anything


def trust(returns: torch.Tensor) -> torch.Tensor:
    """Return p = 1 - tanh(CV) of mean returns a step, CV = std / mean; 0 for a mean <= 0.

    Args:
        returns: Mean reward a step of each world's last episode, (M,).
    """
    mean, std = returns.mean(), returns.std()
    cv = std / mean.clamp(min=1e-3)
    return torch.where(mean > 1e-3, 1.0 - torch.tanh(cv), 0.0)


class AdaBoot:
    """Keeps each world's last completed episode and draws the decisions."""

    def __init__(self, mode: str, floor: float, num_envs: int, device: str) -> None:
        """Begin without episodes: estimates are not trusted, updates are not withheld."""
        self.gates_update = mode in ("gate_update", "both")
        self.bootstraps_input = mode in ("bootstrap_input", "both")
        self._floor = floor
        self._running = torch.zeros(num_envs, device=device)
        self._length = torch.zeros(num_envs, device=device)
        self._last = torch.full((num_envs,), float("nan"), device=device)
        self.probability = torch.zeros((), device=device)
        self._ready = False
        self.uses_estimate = torch.full((num_envs,), not self.bootstraps_input, device=device)

    def record(self, reward: torch.Tensor, done: torch.Tensor) -> None:
        """Add a step's rewards (N,) and dones (N,); in place, as a recorded step has to."""
        self._running += reward
        self._length += 1
        ended = done > 0
        self._last.copy_(torch.where(ended, self._running / self._length, self._last))
        self._running.masked_fill_(ended, 0.0)
        self._length.masked_fill_(ended, 0.0)

    def renew(self) -> None:
        """Once an iteration: renew p, and which worlds' actors see the estimate."""
        last = distributed.gather(self._last)
        known = last[~last.isnan()]
        # one world alone has no spread
        self._ready = len(known) >= max(2, min(_MIN_WORLDS, len(last)))
        if self._ready:
            self.probability = trust(known)
        if self.bootstraps_input:
            draws = torch.rand(len(self._last), device=self._last.device)
            self.uses_estimate.copy_(draws < self.probability)

    def update_allowed(self) -> bool:
        """Draw whether the estimator may be trained in this iteration, on all ranks or on none."""
        if not self.gates_update or not self._ready:
            return True
        draw = distributed.broadcast(torch.rand(()))
        return bool(draw < self.probability.clamp(min=self._floor).cpu())

    def state_dict(self) -> dict:
        """Return the statistics."""
        return self.world_state() | {"probability": self.probability, "ready": self._ready}

    def world_state(self) -> dict:
        """Return what belongs to the worlds of this rank."""
        names = ("_running", "_length", "_last", "uses_estimate")
        return {name: getattr(self, name) for name in names}

    def load_state_dict(self, state: dict) -> None:
        """Go on from saved statistics, or from those of the worlds alone."""
        state = dict(state)
        self._ready = state.pop("ready", self._ready)
        for name, value in state.items():
            setattr(self, name, value.to(self._running.device))
