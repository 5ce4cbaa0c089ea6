"""The network that leaves training: estimator and actor as one module."""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.modules import MLP
from torch import nn

from kiras_rl import interfaces as names
from kiras_rl.classes import find_class
from kiras_rl.models.estimator import VELOCITY_DIM, ContextEstimator, Estimator


class ExportedPolicy(nn.Module):
    """Deterministic policy from observations to raw actions.

    Inputs are what a robot has: the current frame and its recent past. The context that the actor
    was trained with is computed inside, so that the exported file needs nothing but these two.

    Args:
        estimator: Frames that it chooses -> context; None for an actor that reads the history
            itself.
        actor_mlp: Network on [proprio, context], or on [proprio, history] without an estimator, to
            actions (N, J).
    """

    def __init__(self, estimator: Estimator | None, actor_mlp: nn.Module) -> None:
        """Keep both networks; their weights are shared with the caller, not copied."""
        super().__init__()
        self.estimator = estimator
        self.actor = actor_mlp

    def forward(
        self, proprio: torch.Tensor, history: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the actions and the estimated velocity.

        Args:
            proprio: Current frame, (N, P).
            history: Past frames, oldest first, (N, H*P).

        Returns:
            Raw actions (N, J), not yet clipped, and the base velocity in the base frame (N, 3),
            m/s, which is zero without an estimator.
        """
        if self.estimator is None:
            velocity = proprio.new_zeros(proprio.shape[0], 3)
            return self.actor(torch.cat([proprio, history], dim=-1)), velocity
        frames = self.estimator.frames({names.PROPRIO: proprio, names.HISTORY: history})
        context = self.estimator.context(frames)
        return self.actor(torch.cat([proprio, context], dim=-1)), context[..., :VELOCITY_DIM]

    def shape(self) -> dict:
        """Return the sizes from which `build_policy` makes the same networks, without weights."""
        estimator = self.estimator
        return {
            "actor": [(m.in_features, m.out_features) for m in _linears(self.actor)],
            "estimator": None if estimator is None else estimator.shape(),
        }


def build_policy(shape: dict) -> ExportedPolicy:
    """Make a policy with random weights from `ExportedPolicy.shape`.

    Raises:
        ConfigError: An estimator of a class that cannot be found.
    """
    estimator = None if shape["estimator"] is None else _build_estimator(**shape["estimator"])
    sizes = [tuple(pair) for pair in shape["actor"]]
    actor = MLP(sizes[0][0], sizes[-1][1], [out for _, out in sizes[:-1]], "elu")
    return ExportedPolicy(estimator, actor)


def _build_estimator(class_name: str | None = None, **shape: Any) -> Estimator:
    """Make an estimator; what earlier versions saved names no class."""
    kind = ContextEstimator
    if class_name is not None:
        kind = find_class("policy_shape.estimator.class_name", class_name, Estimator)
    return kind(**shape)


def _linears(module: nn.Module) -> list[nn.Linear]:
    return [m for m in module.modules() if isinstance(m, nn.Linear)]
