"""Rollout storage of what the learner can only judge when the rollout is over."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict


class GroupRolloutStorage(RolloutStorage):
    """rsl-rl's storage with G columns in rewards, values and returns.

    A step brings its task reward alone. The learner judges whole rollouts, for one pass over all
    steps costs less than one a step: it then sets `rewards`, `values`, `returns`, (T, N, G).

    A step is written in two halves, what was seen and done and what came of it. `claim_row` says on
    the host that one comes, `write` and `next_row` work on the device.
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
        self.dones = torch.zeros(*shape, 1, device=device)  # floats: an episode may end in part
        self.task_rewards = torch.zeros(*shape, 1, device=device)
        self.time_outs = torch.zeros(*shape, 1, dtype=torch.bool, device=device)
        self.rewards = torch.zeros(*shape, num_groups, device=device)
        self.values = torch.zeros(*shape, num_groups, device=device)
        self.returns = torch.zeros(*shape, num_groups, device=device)
        self.action_mean = torch.zeros(*shape, num_actions, device=device)
        self.action_std = torch.zeros(*shape, num_actions, device=device)
        # On the device, so that a recorded step finds its row
        self._row = torch.zeros(1, dtype=torch.int64, device=device)

    def claim_row(self) -> None:
        """Count a step that is about to be written, on the host: graphs write on the device alone.

        Raises:
            OverflowError: The rollout is full.
        """
        if self.step >= self.num_transitions_per_env:
            raise OverflowError("the rollout is full: clear() the storage before adding to it")
        self.step += 1

    def write(self, observations: Mapping[str, torch.Tensor], **columns: torch.Tensor) -> None:
        """Write some of the current row.

        Args:
            observations: Groups, (N, ...).
            columns: Other buffers, by their names, (N,) or (N, k).
        """
        for name, value in observations.items():
            self.write_row(self.observations[name], value)
        for name, value in columns.items():
            self.write_row(getattr(self, name), value)

    def write_row(self, buffer: torch.Tensor, value: torch.Tensor) -> None:
        """Write the current row of any (T, N, ...) buffer."""
        row = value.to(buffer.dtype).view(1, *buffer.shape[1:])
        buffer.index_copy_(0, self._row, row)

    def next_row(self) -> None:
        """Go on to the next row, on the device."""
        self._row += 1

    def clear(self) -> None:
        """Begin at the first row again."""
        super().clear()
        self._row.zero_()

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
