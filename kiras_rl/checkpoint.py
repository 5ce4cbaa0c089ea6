"""Checkpoints: one file that holds everything, written atomically, read without running code."""

from __future__ import annotations

import pickle
import platform
import zipfile
from collections.abc import Callable
from pathlib import Path

import torch

from kiras_rl import __version__, distributed
from kiras_rl.config import ConfigError
from kiras_rl.deploy.errors import PlainError
from kiras_rl.files import CheckedFile, replacing
from kiras_rl.models.exported import ExportedPolicy, build_policy

FORMAT = 4
FOLDER = "checkpoints"
LATEST, BEST = "latest.pt", "best.pt"
FLAT = "flat.pt"  # the best of skill learning, once finetuning has begun

# What torch.load raises on files that are no zip archives of tensors, truncated, or hold code.
_UNREADABLE = (
    AttributeError,
    EOFError,
    IndexError,
    KeyError,
    OSError,
    RuntimeError,
    ValueError,
    pickle.UnpicklingError,
    zipfile.BadZipFile,
)


class CheckpointError(PlainError, ValueError):
    """A file that is no usable checkpoint: says which and why."""


def save_checkpoint(path: Path, content: dict) -> None:
    """Write a checkpoint and read it back; whatever fails leaves the old file as it was.

    Args:
        path: Where to.
        content: Tensors, numbers, strings, and containers of them.

    Raises:
        OSError: The disk is full, or does not give back what was written.
    """
    with replacing(path) as temporary, temporary.open("wb", buffering=0) as file:
        checked = CheckedFile(file)
        try:
            whole = {"format": FORMAT, "versions": versions()} | content
            torch.save(whole, checked)  # pyright: ignore[reportArgumentType], it writes and flushes
            checked.check(temporary)
        except (OSError, RuntimeError) as error:  # torch hides why its file did not take more
            raise OSError(f"{path} was not written: {_why(error)}") from None


def _why(error: BaseException) -> str:
    """Return the first line of an error, or of the one behind it that the system gave."""
    while not isinstance(error, OSError) and error.__context__ is not None:
        error = error.__context__
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def load_checkpoint(path: Path) -> dict:
    """Read a checkpoint onto the CPU.

    Raises:
        CheckpointError: Missing, truncated or foreign file, or another format.
    """
    if not path.is_file():
        raise CheckpointError(f"no checkpoint at {path}")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except _UNREADABLE as error:
        reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        raise CheckpointError(
            f"{path} is not a whole KiRAS checkpoint ({reason}); the run's other checkpoints are "
            f"in {path.parent}"
        ) from None
    if not isinstance(content, dict) or "format" not in content or "learner" not in content:
        raise CheckpointError(f"{path} is a PyTorch file, but not a KiRAS checkpoint")
    if content["format"] != FORMAT:
        raise CheckpointError(
            f"{path} has checkpoint format {content['format']}, this version reads {FORMAT}"
        )
    return content


def save_ranks(path: Path, make_content: Callable[[], dict], state: dict) -> None:
    """Let rank 0 write one checkpoint for all ranks.

    Args:
        path: Where to.
        make_content: Return all that is the same on every rank, as `save_checkpoint` takes it.
        state: What differs: `env`, `generators` and what the learner knows of this rank's worlds,
            `learner`. Of rank 0 the last one is left out: the content's `learner` has it.
    """
    states = distributed.gather_states(state)

    def write() -> None:
        own = {name: states[0][name] for name in ("env", "generators")}
        save_checkpoint(path, make_content() | own | {"others": states[1:]})

    distributed.from_main(write)


def load_ranks(path: Path) -> tuple[dict, dict]:
    """Let rank 0 read a checkpoint for all ranks.

    Returns:
        The content, with the number of `ranks` that wrote it, and what `save_ranks` took as the
        state of this rank; nothing if another number of ranks wrote it.

    Raises:
        CheckpointError: As `load_checkpoint`, on every rank.
    """
    others: list[dict] = []

    def read() -> dict:
        content = load_checkpoint(path)
        others.extend(content.pop("others", []))
        return content | {"ranks": 1 + len(others)}

    content = distributed.from_main(read)
    if content["ranks"] != distributed.size():
        return content, {}
    first = {"learner": {}} | {name: content[name] for name in ("env", "generators")}
    return content, distributed.scatter_states([first, *others])


def find_checkpoint(source: Path, prefer: str = BEST) -> Path:
    """Return the checkpoint file of a run folder, or the file itself.

    Args:
        source: runs/<cfg>/<time> or a file.
        prefer: BEST or LATEST; the other is taken where it is missing.

    Raises:
        CheckpointError: Nothing there.
    """
    if source.is_file():
        return source
    if not source.is_dir():
        raise CheckpointError(f"{source} does not exist: give a run folder or a checkpoint file")
    for name in (prefer, BEST, LATEST):
        if (source / FOLDER / name).is_file():
            return source / FOLDER / name
    raise CheckpointError(
        f"{source} holds no checkpoint: expected {FOLDER}/{LATEST}, written "
        "every few minutes by kiras-train"
    )


def load_policy(path: Path) -> tuple[ExportedPolicy, dict]:
    """Rebuild the deterministic policy of a checkpoint.

    Returns:
        The policy, and its description as kiras_rl.deploy.metadata.PolicyMetadata spells it.

    Raises:
        CheckpointError: As `load_checkpoint`, or an estimator of a class that cannot be found.
    """
    content = load_checkpoint(path)
    try:
        policy = build_policy(content["policy_shape"])
    except ConfigError as error:
        raise CheckpointError(f"{path}: {error}") from None
    policy.load_state_dict(content["policy"])
    return policy.eval(), content["description"]


def versions() -> dict[str, str]:
    """Return the versions that a result depends on."""
    from importlib.metadata import version

    packages = ("torch", "rsl-rl-lib", "mujoco", "mujoco-warp", "numpy")
    return {
        "kiras-rl": __version__,
        "python": platform.python_version(),
        **{name: version(name) for name in packages},
    }
