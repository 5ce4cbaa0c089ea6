"""What ends a training: numbers that are none, on any rank."""

from __future__ import annotations

import math

from rsl_rl.storage import RolloutStorage
from rsl_rl.utils import check_nan
from tensordict import TensorDict

from kiras_rl import distributed

LOSSES = ("Loss/", "Policy/", "Estimator/", "Discriminator/")
"""Tags of an update that are numbers as long as its weights are."""


class TrainingError(ValueError):
    """A training that cannot go on: says where it broke and what is left."""


def check_rollout(obs: TensorDict, storage: RolloutStorage) -> None:
    """Refuse observations, rewards or dones that are not finite.

    Once a rollout, for every check waits for the device: NaN in an earlier step is still there, in
    the history of observations or in rewards, which hold values of time-outs.

    Raises:
        TrainingError: On all ranks, where one met them.
    """
    fault = ""
    try:
        check_nan(obs, storage.rewards, storage.dones)
    except ValueError as error:
        fault = str(error)
    _agree(fault, "Worlds that diverge are reset before this, so look at your own terms")


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
