"""Gradient descent on a rollout, once for every part: Adam, CUDA graphs, CPU shares and ranks."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable

import torch
from torch import nn

from kiras_rl import distributed
from kiras_rl.recorded import Recorded, Slot
from kiras_rl.shards import Batch, differentiate

Loss = Callable[..., tuple[torch.Tensor, torch.Tensor]]
"""Rows of a batch by their names -> the loss, and what describes it, (k,); see `differentiate`."""


class Trainer:
    """Fits parameters to batches, so that a part of the learner is its networks and their loss.

    Attributes:
        rate: Step size of Adam, a tensor on the device; write to it in place.
        optimizer: Adam.
    """

    def __init__(
        self,
        parameters: Iterable[nn.Parameter],
        loss: Loss,
        rate: float,
        device: str | torch.device,
        batches: Callable[[], Iterable[Batch]],
        adjust: Callable[[torch.Tensor], torch.Tensor] | None = None,
        carried: Callable[[], Iterable[Slot]] = tuple,
        variant: Callable[[], Hashable] = tuple,
    ) -> None:
        """Take what is fitted, and to what.

        Args:
            parameters: What is fitted.
            loss: A mean over the rows of a batch.
            rate: Step size at first.
            device: Of the parameters.
            batches: The batches of a pass, one for each step.
            adjust: Called before each step, when the gradients are those of all ranks, with what
                describes the loss on this rank, (k,); returns what describes it on all.
            carried: Attributes that a pass reads and others replace; see `Recorded`.
            variant: What else decides which operations a pass runs; see `Recorded`.
        """
        self._parameters, self._loss = list(parameters), loss
        self._batches, self._adjust = batches, adjust
        self._on_gpu = torch.device(device).type == "cuda"
        self.rate = torch.tensor(rate, device=device)
        self.optimizer = torch.optim.Adam(
            self._parameters, lr=self.rate, fused=True, capturable=self._on_gpu
        )
        # Ranks wait for each other in a step, which no graph can.
        alone = distributed.size() == 1
        self._pass = Recorded(self._run_pass, device, carried, variant=variant, enabled=alone)

    def train(self, passes: int) -> torch.Tensor:
        """Step through the batches so many times; return the mean of what describes the loss."""
        return torch.stack([self._pass() for _ in range(passes)]).mean(dim=0)

    def _run_pass(self) -> torch.Tensor:
        """Step on every batch; return the mean of what describes the loss, (k,)."""
        return torch.stack([self._step(batch) for batch in self._batches()]).mean(dim=0)

    def _step(self, batch: Batch) -> torch.Tensor:
        numbers = differentiate(self._loss, batch, self._parameters)
        distributed.average_gradients(self._parameters)
        if self._adjust:
            numbers = self._adjust(numbers)
        self.optimizer.step()
        return numbers

    def state_dict(self) -> dict:
        """Return the optimizer's state."""
        return self.optimizer.state_dict()

    def load_state_dict(self, state: dict) -> None:
        """Go on from a state that was saved on any device."""
        self.optimizer.load_state_dict(state)
        for group in self.optimizer.param_groups:  # loading took the step size of the state
            self.rate.copy_(torch.as_tensor(group["lr"]))
            group["lr"], group["capturable"] = self.rate, self._on_gpu
        self._pass.forget()
