"""The profile of a policy's robot: the policy file's, or robot.yaml's for an older file."""

from __future__ import annotations

from kiras_rl.deploy.metadata import PolicyError, PolicyMetadata
from kiras_rl.deploy.profile import Profile


def profile_of(metadata: PolicyMetadata) -> Profile:
    """Return what kiras-robot has to know of the robot of a policy.

    Raises:
        PolicyError: If neither the policy file nor the robot's folder says it.
    """
    if metadata.onboard is not None:
        return metadata.onboard
    found = _todays(metadata.robot)
    if found is None:
        raise PolicyError(
            f"neither the policy file nor robots/{metadata.base_robot}/robot.yaml has the numbers "
            "of kiras-robot: write them there as `onboard` (docs/extending.md)"
        )
    return found


def source_of(metadata: PolicyMetadata) -> str:
    """Say where the numbers of `profile_of` are from."""
    if metadata.onboard is not None:
        return "the policy file"
    return f"robots/{metadata.base_robot}/robot.yaml, for the policy file is older than they"


def _todays(robot: str) -> Profile | None:
    """Return what the robot's folder says, where the whole project is installed."""
    try:
        from kiras_rl.robots.robot import load_robot
    except ImportError:
        raise PolicyError(
            "this policy file is older than the numbers of kiras-robot, and without the whole "
            "project there is no robot.yaml: complete it elsewhere by kiras-export OLD --out NEW"
        ) from None
    try:
        onboard = load_robot(robot).onboard
    except ValueError as error:  # RobotError, which cannot be imported where MuJoCo is not
        raise PolicyError(str(error)) from None
    return None if onboard is None else Profile.from_dict(onboard)
