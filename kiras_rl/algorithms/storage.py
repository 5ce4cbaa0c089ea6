"""Rollout storage of what the learner can only judge when the rollout is over."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict


class GroupRolloutStorage(RolloutStorage):
    """rsl-rl's storage with G columns in rewards, values and returns.

    A step brings its task reward alone. The learner judges whole rollouts, for one pass over all
    steps costs less than one a step: it then sets `rewards`, `values`, `returns`, (T, N, G).
    """

    def __init__(
        self,
        num_envs: int,
        num_steps: int,
        num_groups: int,
        obs: TensorDict,
        num_actions: int,
        device: str,
    ) -> None:
        """Allocate (T, N, ...) buffers."""
        super().__init__("rl", num_envs, num_steps, obs, [num_actions], device)
        shape = (num_steps, num_envs)
        self.task_rewards = torch.zeros(*shape, 1, device=device)
        self.time_outs = torch.zeros(*shape, 1, dtype=torch.bool, device=device)
        self.rewards = torch.zeros(*shape, num_groups, device=device)
        self.values = torch.zeros(*shape, num_groups, device=device)
        self.returns = torch.zeros(*shape, num_groups, device=device)

    def add_transition(self, transition: RolloutStorage.Transition) -> None:
        """Add one step.

        Args:
            transition: `rewards` (N,) are of the task; `time_outs` (N,) tells which `dones` (N,)
                are of the clock.
        """
        if self.step >= self.num_transitions_per_env:
            raise OverflowError("the rollout is full: clear() the storage before adding to it")
        step = self.step
        self.observations[step].copy_(transition.observations)
        self.actions[step] = transition.actions
        self.task_rewards[step] = transition.rewards.view(-1, 1)
        self.dones[step] = transition.dones.view(-1, 1)
        self.time_outs[step] = transition.time_outs.view(-1, 1)
        self.actions_log_prob[step] = transition.actions_log_prob.view(-1, 1)
        if self.distribution_params is None:
            self.distribution_params = tuple(
                torch.zeros(self.num_transitions_per_env, *p.shape, device=self.device)
                for p in transition.distribution_params
            )
        for stored, new in zip(
            self.distribution_params, transition.distribution_params, strict=True
        ):
            stored[step] = new
        self.step += 1

    def shuffle_into(self, data: dict[str, torch.Tensor], **tensors: torch.Tensor) -> None:
        """Write (T, N, ...) tensors into `data`, flat and in one random order, (T * N, ...).

        The tensors of `data` are made at the first call and stay the same from then on.
        """
        count = self.num_transitions_per_env * self.num_envs
        order = torch.randperm(count, device=self.device)
        for name, tensor in tensors.items():
            rows = tensor.flatten(0, 1)
            if name not in data:
                data[name] = torch.empty_like(rows)
            torch.index_select(rows, 0, order, out=data[name])


def mini_batches(data: dict[str, torch.Tensor], count: int) -> Iterator[dict[str, torch.Tensor]]:
    """Yield `count` slices of shuffled data; they are views, and cost nothing."""
    size = len(next(iter(data.values()))) // count
    for i in range(count):
        yield {name: x[i * size : (i + 1) * size] for name, x in data.items()}
