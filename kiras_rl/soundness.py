"""What ends a training: numbers that are none, on any rank."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import torch
from rsl_rl.storage import RolloutStorage
from rsl_rl.utils import check_nan
from tensordict import TensorDict

from kiras_rl import distributed
from kiras_rl.deploy.errors import PlainError

NameTerm = Callable[[str, int], str]
LOSSES = ("Loss/", "Policy/", "Estimator/", "Discriminator/")
"""Tags of an update that are numbers as long as its weights are."""


class TrainingError(PlainError, ValueError):
    """A training that cannot go on: says where it broke and what is left."""


def check_rollout(
    obs: TensorDict, storage: RolloutStorage, log: dict[str, float], name: NameTerm
) -> None:
    """Refuse observations, rewards or dones that are not finite.

    Once a rollout, for every check waits for the device: NaN in an earlier step is still there, in
    the history of observations or in rewards, which hold values of time-outs.

    Args:
        obs: The last observations.
        storage: The rollout.
        log: Of the environment; it names the terms of the reward.
        name: Names the term that a column of a group of observations comes from.

    Raises:
        TrainingError: On all ranks, where one met them.
    """
    fault = ""
    try:
        check_nan(obs, storage.rewards, storage.dones)
    except ValueError as error:
        terms = _broken_terms(obs, log, name)
        fault = f"not finite: {', '.join(terms)}." if terms else str(error)
    _agree(fault, "Worlds that diverge are reset before this, so look at your own terms")


def _broken_terms(
    obs: Mapping[str, torch.Tensor], log: dict[str, float], name: NameTerm
) -> list[str]:
    terms = [k for k, v in log.items() if k.startswith("Reward/") and not math.isfinite(v)]
    for group, values in obs.items():
        columns = (~torch.isfinite(values)).reshape(len(values), -1).any(dim=0).nonzero().flatten()
        terms += [name(str(group), int(column)) for column in columns]
    return list(dict.fromkeys(terms))


def check_update(scalars: dict[str, float]) -> None:
    """Refuse weights that are not finite: the worlds that they break are reset, and look sound.

    Args:
        scalars: Of the update, by tag.

    Raises:
        TrainingError: On all ranks, where one has them.
    """
    broken = [k for k, v in scalars.items() if k.startswith(LOSSES) and not math.isfinite(v)]
    fault = f"{', '.join(broken)} not finite." if broken else ""
    _agree(fault, "Look at the learning rates of learner")


def _agree(fault: str, advice: str) -> None:
    if distributed.any_rank(bool(fault)):
        fault = fault or "Another rank met values that are not finite."
        raise TrainingError(f"{fault} {advice}, or lower learner.ppo.learning_rate")
