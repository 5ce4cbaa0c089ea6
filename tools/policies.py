"""Opening a policy for batches of simulated robots, from whatever holds one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from tensordict import TensorDict

from kiras_rl import checkpoint
from kiras_rl.checkpoint import CheckpointError
from kiras_rl.deploy.metadata import PolicyMetadata
from kiras_rl.models.exported import ExportedPolicy
from kiras_rl.robots.robot import ROBOTS


@dataclass(frozen=True)
class OpenPolicy:
    """A policy and where it came from.

    Attributes:
        path: The file.
        metadata: What the policy says of itself.
        act: Observation -> mean actions, (N, J).
    """

    path: Path
    metadata: PolicyMetadata
    act: Callable[[TensorDict], torch.Tensor]


def open_policy(given: str | None, robot: str) -> OpenPolicy:
    """Open a run folder, a checkpoint, an ONNX file, or the policy shipped with a robot.

    Raises:
        CheckpointError: Nothing usable there.
        PolicyError: A foreign ONNX file.
    """
    path = Path(given) if given is not None else shipped_policy(robot)
    if path.suffix == ".onnx":
        return _open_onnx(path)
    file = checkpoint.find_checkpoint(path)
    policy, description = checkpoint.load_policy(file)
    return OpenPolicy(file, PolicyMetadata.from_dict(description), as_function(policy))


def shipped_policy(robot: str) -> Path:
    """Return the flat-ground policy that comes with a robot.

    Raises:
        CheckpointError: There is none.
    """
    path = ROBOTS / robot / "policies" / "flat.onnx"
    if not path.is_file():
        raise CheckpointError(
            f"no policy comes with robot '{robot}' ({path} is missing): give a run folder, a "
            "checkpoint or an ONNX file, or train one with kiras-train"
        )
    return path


def as_function(policy: ExportedPolicy) -> Callable[[TensorDict], torch.Tensor]:
    """Return observation -> mean actions of an exported policy."""

    def act(obs: TensorDict) -> torch.Tensor:
        with torch.no_grad():
            return policy(obs["proprio"], obs["history"])[0]

    return act


def _open_onnx(path: Path) -> OpenPolicy:
    from kiras_rl.deploy.policy import OnboardPolicy

    onboard = OnboardPolicy(path)

    def act(obs: TensorDict) -> torch.Tensor:
        actions, _ = onboard.infer(obs["proprio"].numpy(), obs["history"].numpy())
        return torch.from_numpy(actions)

    return OpenPolicy(path, onboard.metadata, act)
