"""Recorded motions as experts: the frames of a dataset in the features that the learner compares.

Letters: M frames, D features, B pairs.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from kiras_rl.config import ConfigError
from kiras_rl.dataset import Dataset, DatasetError, load_dataset
from kiras_rl.interfaces import SkillEnv

SHIPPED = Path(__file__).resolve().parent.parent / "baselines" / "motions"
"""Folder of the motions that come with this package."""

TERMS: dict[str, Callable[[Dataset, np.ndarray], np.ndarray]] = {
    "projected_gravity": lambda data, _: data["projected_gravity"],
    "base_lin_vel": lambda data, _: to_base_frame(
        data["base_lin_vel_h"], data["projected_gravity"]
    ),
    "base_ang_vel": lambda data, _: data["base_ang_vel_b"],
    "base_height": lambda data, _: data["base_height"],
    "joint_pos": lambda data, default_joint_pos: data["joint_pos"] - default_joint_pos,
    "joint_vel": lambda data, _: data["joint_vel"],
}
"""What of `env.observations.imitation` a dataset holds; no label of a skill among it."""

_LEAST_STD = 1e-2
_CLIP = 10.0


class Motions:
    """Frames of experts, and what makes their features comparable.

    Attributes:
        frames: Normalised, (M, D).
        mean: Of the features before that, (D,).
    """

    def __init__(self, frames: torch.Tensor, first: torch.Tensor) -> None:
        """Take features.

        Args:
            frames: Phi of every frame, (M, D).
            first: Frames that another one of the same motion follows, (pairs,).
        """
        self.mean, self._std = frames.mean(dim=0), frames.std(dim=0)
        self._first = first
        self.frames = self.normalize(frames)

    def normalize(self, features: torch.Tensor) -> torch.Tensor:
        """Return features (..., D) in standard deviations from the mean of the motions."""
        return ((features - self.mean) / (self._std + _LEAST_STD)).clamp(-_CLIP, _CLIP)

    def draw_pairs(self, count: int) -> torch.Tensor:
        """Draw normalised pairs of consecutive frames, (B, 2 D)."""
        drawn = torch.randint(len(self._first), (count,), device=self._first.device)
        first = self._first[drawn]
        return torch.cat([self.frames[first], self.frames[first + 1]], dim=-1)


def load_motions(name: str, env: SkillEnv, device: str) -> Motions:
    """Read a dataset of kiras-collect without its labels.

    Args:
        name: A folder, or the name of one in `SHIPPED`.
        env: Tells the robot, its control rate and the terms of Phi.
        device: Of the tensors.

    Raises:
        ConfigError: No dataset, or one of another robot or rate, or without a term of Phi.
    """
    folder = SHIPPED / name if (SHIPPED / name).is_dir() else Path(name)
    try:
        data = load_dataset(folder)
        features = _features(data, env)
    except DatasetError as error:
        shipped = ", ".join(sorted(path.name for path in SHIPPED.glob("*")))
        raise ConfigError(
            f"dataset={name}: {error}; give the folder of a dataset, or one of: {shipped}"
        ) from None
    first = np.flatnonzero(~data.done[:-1])
    return Motions(
        torch.as_tensor(features, dtype=torch.float32, device=device),
        torch.as_tensor(first, device=device),
    )


def _features(data: Dataset, env: SkillEnv) -> np.ndarray:
    """Return Phi of every frame, (M, D), with the terms and scales of the environment."""
    robot = env.describe()
    if data.robot != robot["robot"] or abs(data.rate * env.step_dt - 1.0) > 1e-6:
        raise DatasetError(
            f"it is of {data.robot} at {data.rate:g} Hz, not of {robot['robot']} at "
            f"{1 / env.step_dt:g} Hz"
        )
    unknown = [term for term, _, _ in env.imitation_terms if term not in TERMS]
    if unknown:
        raise DatasetError(
            f"no motion has env.observations.imitation.{unknown[0]}; allowed are {', '.join(TERMS)}"
        )
    default = np.asarray(robot["default_joint_pos"])
    columns = [scale * TERMS[term](data, default) for term, _, scale in env.imitation_terms]
    return np.concatenate(columns, axis=1)


def to_base_frame(velocity_h: np.ndarray, gravity_b: np.ndarray) -> np.ndarray:
    """Turn vectors of the heading frame, (M, 3), into the base frame.

    The axes of the heading frame, seen from the base: up is against gravity, ahead is the base's x
    axis without what of it points up.

    Args:
        velocity_h: In the heading frame, (M, 3).
        gravity_b: Unit vectors of gravity in the base frame, (M, 3).
    """
    up = -gravity_b
    ahead = np.array([1.0, 0.0, 0.0]) - up[:, :1] * up
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    axes = np.stack([ahead, np.cross(up, ahead), up], axis=1)
    return np.einsum("mi,mik->mk", velocity_h, axes)
