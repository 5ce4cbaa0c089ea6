"""From what a user points at (a run, a checkpoint, a policy file, nothing) to a policy file.

Without torch, unless a checkpoint has to be exported.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from kiras_rl.deploy.policy import OnboardPolicy, PolicyError, PolicyMetadata
from kiras_rl.deploy.profile import Profile
from kiras_rl.robots.robot import Keyframe, Robot, RobotError, list_robots, load_robot

if TYPE_CHECKING:
    from kiras_rl.export import ExportReport

CHECKPOINTS = ("checkpoints/best.pt", "checkpoints/latest.pt")
"""Of a run, in the order in which they are taken."""

_SHIPPED = "flat.onnx"
_DEFAULT_ROBOT = "solo8"


def load_policy(source: Path | None, robot: str | None = None) -> OnboardPolicy:
    """Load the policy that a command's arguments mean; checkpoints are exported on the fly.

    Args:
        source: Run folder, checkpoint or ONNX file; None for the policy shipped with the robot.
        robot: Name of the robot, or None for the policy's own.

    Raises:
        PolicyError: If there is no policy, or it is one of another robot.
        RobotError: If there is no such robot.
    """
    path = shipped_policy(robot or _DEFAULT_ROBOT) if source is None else find_policy(source)
    with TemporaryDirectory() as folder:
        if path.suffix == ".pt":
            path = export_checkpoint(path, Path(folder) / "policy.onnx").path
        policy = OnboardPolicy(path)
    if robot not in (None, policy.metadata.robot):
        raise PolicyError(
            f"--robot {robot} was given, but {source} is a policy of {policy.metadata.robot}"
        )
    return policy


def robot_of(metadata: PolicyMetadata) -> Robot:
    """Return a policy's robot as it was in training, whatever its folder says today.

    Keyframes, default pose, gains, limits and action scales are those of the policy file.

    Raises:
        RobotError: If the robot of the policy is unknown or has other joints.
    """
    robot = load_robot(metadata.robot)
    check_joints(robot, metadata)
    arrays = ("default_joint_pos", "kp", "kd", "torque_limit", "action_scale")
    unlimited = np.full((len(robot.joint_names), 2), (-np.inf, np.inf))
    limits, speeds = metadata.joint_limits, metadata.velocity_limit
    return replace(
        robot,
        keyframes=tuple(_keyframe(metadata, skill) for skill in metadata.skills),
        joint_limits=unlimited if limits is None else np.array(limits),
        velocity_limit=unlimited[:, 1] if speeds is None else np.array(speeds),
        **{name: np.array(getattr(metadata, name)) for name in arrays},
    )


def check_joints(robot: Robot, metadata: PolicyMetadata) -> None:
    """Refuse a policy of other joints.

    Raises:
        RobotError: If the robot has other joints than the policy.
    """
    if robot.joint_names != metadata.joint_names:
        raise RobotError(
            f"the policy was trained for the joints {', '.join(metadata.joint_names)}, "
            f"but robot '{robot.name}' has {', '.join(robot.joint_names)}"
        )


def _keyframe(metadata: PolicyMetadata, skill: str) -> Keyframe:
    posture = metadata.keyframes[skill]
    return Keyframe(skill, posture.base_height, posture.pitch, np.array(posture.joint_pos))


def shipped_policy(robot: str) -> Path:
    """Return the policy file that comes with a robot.

    Raises:
        PolicyError: If none comes with it.
        RobotError: If there is no such robot.
    """
    folder = load_robot(robot).folder / "policies"
    files = sorted(folder.glob("*.onnx"))
    if not files:
        raise PolicyError(
            f"no policy comes with {robot}: name a run folder, a checkpoint or an ONNX file, "
            "or train one with kiras-train"
        )
    return folder / _SHIPPED if folder / _SHIPPED in files else files[-1]


def find_policy(source: Path) -> Path:
    """Return the ONNX file or checkpoint that a path means.

    Of a run folder this is policy.onnx, else checkpoints/best.pt, else checkpoints/latest.pt.

    Raises:
        PolicyError: If there is none.
    """
    return _find(source, ("policy.onnx", *CHECKPOINTS), (".onnx", ".pt"))


def find_checkpoint(source: Path) -> Path:
    """Return the checkpoint that a run folder or a path means.

    Raises:
        PolicyError: If there is none.
    """
    return _find(source, CHECKPOINTS, (".pt",))


def _find(source: Path, in_run: tuple[str, ...], suffixes: tuple[str, ...]) -> Path:
    if source.is_file():
        if source.suffix in suffixes:
            return source
        raise PolicyError(f"{source} is none of: run folder, {', '.join(suffixes)}")
    if not source.is_dir():
        raise PolicyError(f"there is no file or folder {source}")
    for name in in_run:
        if (source / name).is_file():
            return source / name
    runs = sorted(path.parent.name for path in source.glob("*/config.yaml"))
    inside = f"; it holds the runs {', '.join(runs)}: name one of them" if runs else ""
    raise PolicyError(f"run {source} holds none of {', '.join(in_run)}{inside}")


def with_todays_profile(metadata: PolicyMetadata) -> PolicyMetadata:
    """Return a description with what kiras-robot needs, as robot.yaml has it today.

    It stays as it is where the robot's folder has no block `onboard`, or is not here.
    """
    base = metadata.base_robot
    onboard = load_robot(metadata.robot).onboard if base in list_robots() else None
    return metadata if onboard is None else replace(metadata, onboard=Profile.from_dict(onboard))


def export_checkpoint(checkpoint: Path, path: Path) -> ExportReport:
    """Export a checkpoint to a policy file.

    Raises:
        PolicyError: If the checkpoint cannot be read or exported.
    """
    # imported here: torch takes seconds, and a policy file needs none of it
    from kiras_rl import checkpoint as checkpoints
    from kiras_rl.export import export_policy

    try:
        networks, description = checkpoints.load_policy(checkpoint)
        metadata = PolicyMetadata.from_dict(description)
        if metadata.onboard is None:
            metadata = with_todays_profile(metadata)
        return export_policy(networks, metadata, path)
    except ValueError as error:  # CheckpointError, ExportError: known without importing torch
        raise PolicyError(str(error)) from error
