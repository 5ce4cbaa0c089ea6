"""A part of a learner: a block of the YAML that sees rollouts and shapes what is learned from them.

Actor and critics belong to the algorithm; everything beside them is a part, and the algorithm asks
all parts the same questions, in their order. A part answers those that concern it.

Letters: T steps, N worlds, J joints, S skills.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from tensordict import TensorDict
from torch import nn

from kiras_rl.interfaces import SkillEnv
from kiras_rl.schema import LearnerConfig
from kiras_rl.shards import Batch

if TYPE_CHECKING:
    from kiras_rl.algorithms.storage import GroupRolloutStorage
    from kiras_rl.models.estimator import Estimator
    from kiras_rl.models.exported import ExportedPolicy


@dataclass(frozen=True)
class Setting:
    """What a part is built for.

    Attributes:
        obs: A first observation.
        env: The environment.
        config: The whole learner.
        device: Of networks and rollouts.
        bfloat16: Whether hidden layers of critics and discriminators multiply in it.
        reward_scale: Factor of all rewards of a step.
    """

    obs: TensorDict
    env: SkillEnv
    config: LearnerConfig
    device: str
    bfloat16: bool
    reward_scale: float


@dataclass
class Outcome:
    """What came of a step.

    A part may replace `rewards` and `dones`: the parts after it and the rollout get what it leaves.

    Attributes:
        seen: Observations before the step.
        actions: What was done, (N, J).
        rewards: Task reward, (N,).
        dones: Ended episodes, (N,); a number between 0 and 1 ends one in part.
        extras: What the environment tells beside; see kiras_rl.interfaces.
    """

    seen: Mapping[str, torch.Tensor]
    actions: torch.Tensor
    rewards: torch.Tensor
    dones: torch.Tensor
    extras: Mapping[str, torch.Tensor]


@dataclass(frozen=True)
class Iteration:
    """When an update takes place, and how the policy was just updated.

    Attributes:
        number: Iterations of the phase that are done.
        mini_batches: Of a pass over the rollout.
        actor_rate: Step size of the actor, a tensor of one number.
    """

    number: int
    mini_batches: int
    actor_rate: torch.Tensor


class Part:
    """A part that does nothing; see the module."""

    settings: ClassVar[type | None] = None
    """Dataclass of the keys that its block in `learner.parts` has beside `class_name`; None for a
    part that reads its block itself."""

    reward_group: ClassVar[str | None] = None
    """Name of the reward that `rewards` returns, which gets a critic of its own."""

    learns_from: ClassVar[tuple[str, ...]] = ()
    """Groups of the rollout's observations whose rows `policy_loss` takes."""

    probabilities: torch.Tensor | None = None
    """How likely the environment shall draw each skill, (S,); None for no opinion."""

    @classmethod
    def build(cls, config: Any, setting: Setting) -> Part:
        """Build from a block of the configuration, as `settings` types it.

        Raises:
            ConfigError: A value that is not allowed.
        """
        raise NotImplementedError

    def meet(self, policy: ExportedPolicy) -> None:
        """Get to know the policy that is trained, before anything is."""

    def groups(self, obs: TensorDict) -> dict[str, torch.Tensor]:
        """Return examples, (N, ...), of the observations that this part adds to a rollout."""
        return {}

    # --- in a step of the rollout -----------------------------------------------------------------

    def observe(self, obs: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Return observations to add before the actor acts."""
        return {}

    def record(self, rollout: GroupRolloutStorage, step: Outcome) -> dict[str, torch.Tensor]:
        """See a step and return observations to store with it; in place, as in any graph."""
        return {}

    # --- when it is over --------------------------------------------------------------------------

    def rewards(self) -> torch.Tensor:
        """Return the reward of `reward_group` for every step, (T, N)."""
        raise NotImplementedError

    def prepare(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Return what `policy_loss` needs to know of a whole mini-batch, one row for each of it."""
        return {}

    def policy_loss(self, mean: torch.Tensor, batch: Batch) -> torch.Tensor | float:
        """Return what to add to the loss of the policy.

        Args:
            mean: Mean actions, (B, J).
            batch: Rows of `learns_from` and of what `prepare` returned, (B, ...).
        """
        return 0.0

    def update(self, rollout: GroupRolloutStorage, iteration: Iteration) -> dict[str, float]:
        """Learn from the rollout; return scalars for the log, by their full names."""
        return {}

    def describe(self, rollout: GroupRolloutStorage) -> dict[str, float]:
        """Return scalars for the log, before anything is updated."""
        return {}

    def set_progress(self, progress: float) -> None:
        """Set what changes over the phase to its value at this share of it, in [0, 1]."""

    def choose_skills(self, values: torch.Tensor, practised: torch.Tensor) -> None:
        """Renew `probabilities`.

        Args:
            values: Task value of each skill at its keyframe, (S,).
            practised: Steps of each skill in the rollout, (S,).
        """

    # --- state ------------------------------------------------------------------------------------

    def networks(self) -> dict[str, nn.Module]:
        """Return all networks, by names that no other part uses."""
        return {}

    def lasting(self) -> dict[str, nn.Module]:
        """Return the networks that go on into the next phase."""
        return {}

    def onboard(self) -> Estimator | None:
        """Return the network that the robot needs beside the actor."""
        return None

    def begin_from(self, networks: dict[str, dict], state: dict) -> None:
        """Begin a phase where the one before ended.

        Args:
            networks: Weights of the actor, the task critic, and what was `lasting`.
            state: What `state_dict` of this part returned there; empty where it did not exist.
        """
        for name, network in self.lasting().items():
            network.load_state_dict(networks[name])

    def state_dict(self) -> dict:
        """Return everything that further training depends on."""
        return {}

    def load_state_dict(self, state: dict) -> None:
        """Go on from a saved state."""

    def world_state(self) -> dict:
        """Return what of the state belongs to the worlds of this rank."""
        return {}

    def load_world_state(self, state: dict) -> None:
        """Go on from what `world_state` returned."""
