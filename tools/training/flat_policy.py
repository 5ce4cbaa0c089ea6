"""A policy of an earlier skill learning as the beginning of a finetuning: does it fit?"""

from __future__ import annotations

from pathlib import Path

from kiras_rl.checkpoint import FLAT, CheckpointError, load_checkpoint
from kiras_rl.config import ConfigError
from kiras_rl.deploy.policy import PolicyMetadata
from kiras_rl.phases import SKILL_LEARNING
from kiras_rl.runner import KirasRunner
from kiras_rl.schema import Config

FREE = ("format", "version", "provenance", "command_range")
"""What of a policy's description may differ: finetuning has commands of its own."""


def read_flat(path: Path, config: Config) -> dict:
    """Read the checkpoint with whose best policy the finetuning of a run begins.

    Raises:
        CheckpointError: Unusable file, or one that holds no flat policy.
        ConfigError: A run without finetuning.
    """
    if config.finetuning is None:
        raise ConfigError(
            "--flat begins terrain finetuning, which this configuration leaves out: "
            "finetuning=null; take one with both phases, such as solo8"
        )
    content = load_checkpoint(path)
    if content["phase"] != SKILL_LEARNING:
        raise CheckpointError(
            f"{path} is of the phase {content['phase']}: give a checkpoint of {SKILL_LEARNING}, "
            f"such as {FLAT} of the same run"
        )
    if content["best_networks"] is None:
        raise CheckpointError(
            f"{path} was written before the first evaluation, so no policy is the best yet: let "
            "its skill learning go on"
        )
    return content


def check_fit(path: Path, content: dict, runner: KirasRunner) -> None:
    """Compare robot, skills, observations and network sizes of a checkpoint with a learner's.

    Args:
        path: The checkpoint, to name it.
        content: What it holds.
        runner: The learner of finetuning.

    Raises:
        CheckpointError: At the first difference.
    """
    given, wanted = _properties(content["description"]), _properties(runner.describe_policy())
    given |= sizes(content["best_networks"])
    wanted |= sizes(runner.alg.networks())
    for name in given | wanted:
        if given.get(name) != wanted.get(name):
            raise CheckpointError(
                f"{path} does not fit this configuration: other {name}"
                f"{_quote(given.get(name), wanted.get(name))}; finetune it with the robot, "
                "observations and networks that it was trained with"
            )


def _properties(description: dict) -> dict:
    values = PolicyMetadata.from_dict(description).to_dict()
    return {name: value for name, value in values.items() if name not in FREE}


def sizes(networks: dict) -> dict[str, list[tuple[int, ...]]]:
    """Return the shapes of all weights of each network."""
    return {
        f"sizes of the {name}": [tuple(weight.shape) for weight in weights.values()]
        for name, weights in networks.items()
    }


def _quote(given: object, wanted: object) -> str:
    """Return both values where they are short enough to be read."""
    text = f" ({given} there, {wanted} here)"
    return text if len(text) < 60 else ""
