"""What the learner does in a step of the rollout, before and after the environment's."""

from __future__ import annotations

from types import SimpleNamespace

import torch
from tensordict import TensorDict

from kiras_rl import interfaces as names
from kiras_rl.algorithms.part import Outcome
from kiras_rl.algorithms.parts import Learner
from kiras_rl.recorded import Recorded, Slot

OUTCOME = (
    names.NEXT_PROPRIO,
    names.EXTRA_TIME_OUTS,
    names.EXTRA_IMITATION,
    names.EXTRA_VALID,
    names.EXTRA_FLAT,
    names.EXTRA_CONSTRAINTS,
)
"""What of `extras` is learned from."""


class Rollout:
    """Acts, and stores what was seen, done and what came of it.

    On a GPU either half is one graph instead of fifty small kernels.
    """

    def __init__(self, learner: Learner, device: str) -> None:
        """Take the learner, whose parts see every step."""
        self._learner = learner
        self._seen, self._outcome = SimpleNamespace(), SimpleNamespace()  # of the current step
        self._act = Recorded(self._act_and_write, device, carried=lambda: _slots(self._seen))
        self._store = Recorded(
            self._write_outcome, device, carried=lambda: _slots(self._seen, self._outcome)
        )

    @torch.no_grad()
    def act(self, obs: TensorDict) -> torch.Tensor:
        """Sample actions, (N, J).

        Raises:
            OverflowError: The rollout is full.
        """
        self._learner.storage.claim_row()
        vars(self._seen).update(obs)
        self._outcome.actions = self._act()
        return self._outcome.actions

    @torch.no_grad()
    def store(self, rewards: torch.Tensor, dones: torch.Tensor, extras: dict) -> None:
        """Store what the environment returned for the last actions.

        Args:
            rewards: Task reward, (N,).
            dones: Ended episodes, (N,).
            extras: See kiras_rl.interfaces.
        """
        vars(self._outcome).update({name: extras[name] for name in OUTCOME if name in extras})
        self._outcome.rewards, self._outcome.dones = rewards, dones
        self._store()

    def forget(self) -> None:
        """Record anew: a loaded checkpoint replaced what the graphs write to."""
        self._act.forget()
        self._store.forget()

    def _act_and_write(self) -> torch.Tensor:
        learner, seen = self._learner, vars(self._seen)
        for part in learner.parts.values():
            seen = seen | part.observe(seen)
        distribution = learner.actor.distribution
        distribution.update(learner.actor.mlp(learner.actor.get_latent(seen)))
        mean, std = distribution.params
        # Not its sample(): torch.normal reads the smallest deviation, and so waits for the device
        actions = mean + std * torch.randn_like(mean)
        learner.storage.write(
            seen,
            actions=actions,
            actions_log_prob=distribution.log_prob(actions),
            action_mean=mean,
            action_std=std,
        )
        return actions

    def _write_outcome(self) -> tuple[()]:
        storage, outcome = self._learner.storage, vars(self._outcome)
        given = (outcome[name] for name in ("actions", "rewards", "dones"))
        step = Outcome(vars(self._seen), *given, extras=outcome)
        observed: dict[str, torch.Tensor] = {}
        for part in self._learner.parts.values():
            observed |= part.record(storage, step)
        time_outs = outcome[names.EXTRA_TIME_OUTS]
        storage.write(observed, task_rewards=step.rewards, dones=step.dones, time_outs=time_outs)
        storage.next_row()
        return ()


def _slots(*owners: SimpleNamespace) -> list[Slot]:
    """Return all attributes of all owners."""
    return [(owner, name) for owner in owners for name in vars(owner)]
