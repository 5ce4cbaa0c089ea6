"""Damage files at random, by seed, and load them: each is still usable, or refused in one line.

PYTHONPATH=tests python -m campaigns.mutations [SEEDS]

Files are those of a robot, a configuration, a checkpoint, a policy and a dataset. Whatever else
happens, an error of another kind or a message of several lines, is a fault, printed with its seed.
"""

from __future__ import annotations

import random
import re
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from kiras_rl.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from kiras_rl.config import CFG_FOLDER, ConfigError, load_config
from kiras_rl.dataset import Dataset, DatasetError, Feature, load_dataset, save_dataset
from kiras_rl.deploy.policy import OnboardPolicy, PolicyError
from kiras_rl.robots.robot import ROBOTS, RobotError, load_robot

VALUES = (b"0", b"-1", b"1e9", b".nan", b".inf", b"1e400", b"x", b"[]", b"null", b"")
REFUSALS = (CheckpointError, ConfigError, DatasetError, PolicyError, RobotError)


def mutate(data: bytes, rng: random.Random) -> bytes:
    """Return data with one to four damages: bytes, numbers and lines changed, lost or doubled."""
    for _ in range(rng.randint(1, 4)):
        data = rng.choice((_flip, _cut, _double, _truncate, _renumber, _swap_lines))(data, rng)
    return data


def _span(data: bytes, rng: random.Random) -> tuple[int, int]:
    first = rng.randrange(len(data) + 1)
    return first, min(len(data), first + rng.randint(1, 40))


def _flip(data: bytes, rng: random.Random) -> bytes:
    first, _ = _span(data, rng)
    return data[:first] + bytes([rng.randrange(256)]) + data[first + 1 :]


def _cut(data: bytes, rng: random.Random) -> bytes:
    first, last = _span(data, rng)
    return data[:first] + data[last:]


def _double(data: bytes, rng: random.Random) -> bytes:
    first, last = _span(data, rng)
    return data[:last] + data[first:]


def _truncate(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _renumber(data: bytes, rng: random.Random) -> bytes:
    numbers = [match.span() for match in re.finditer(rb"-?\d+\.?\d*", data)]
    first, last = rng.choice(numbers or [(0, 0)])
    return data[:first] + rng.choice(VALUES) + data[last:]


def _swap_lines(data: bytes, rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    a, b = rng.randrange(len(lines)), rng.randrange(len(lines))
    lines[a], lines[b] = lines[b], lines[a]
    return b"\n".join(lines)


def subjects(folder: Path) -> dict[Path, Callable[[], object]]:
    """Write whole files; return what loads each."""
    robot = shutil.copytree(ROBOTS / "solo8", folder / "solo8")
    configuration = Path(shutil.copy(CFG_FOLDER / "base.yaml", folder / "mine.yaml"))
    policy = Path(shutil.copy(ROBOTS / "solo8" / "policies" / "flat.onnx", folder))
    saved = folder / "latest.pt"
    save_checkpoint(saved, {"learner": {"weights": torch.ones(99)}, "iteration": 7})
    dataset = _save_dataset(folder / "dataset")

    def load() -> object:
        return load_robot("solo8", folder).spec(visuals=False).compile()

    return {
        robot / "robot.yaml": load,
        robot / "keyframes.yaml": load,
        robot / "solo8.xml": load,
        configuration: lambda: load_config(str(configuration)),
        policy: lambda: OnboardPolicy(policy),
        saved: lambda: load_checkpoint(saved),
        dataset / "dataset.json": lambda: load_dataset(dataset),
        dataset / "dataset.npz": lambda: load_dataset(dataset),
    }


def _save_dataset(folder: Path) -> Path:
    count = 20
    labels = {"episode": np.zeros(count, int), "skill": np.zeros(count, int)}
    ends = {"done": np.arange(count) == count - 1, "fallen": np.zeros(count, bool)}
    values, features = {"height": np.ones((count, 1))}, {"height": Feature(("z",), ("m",))}
    dataset = Dataset("solo8", 50.0, ("walk",), features, values, **labels, **ends, provenance={})
    save_dataset(dataset, folder)
    return folder


def fault(load: Callable[[], object]) -> str | None:
    """Load a file; return what is wrong with how it fails, None if nothing is."""
    try:
        load()
    except REFUSALS as error:
        return f"several lines: {error!s}" if "\n" in str(error) else None
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return None


def campaign(seeds: range) -> list[str]:
    """Damage every file once for each seed; return the faults."""
    faults = []
    with tempfile.TemporaryDirectory() as folder:
        for path, load in subjects(Path(folder)).items():
            whole = path.read_bytes()
            for seed in seeds:
                path.write_bytes(mutate(whole, random.Random(f"{path.name} {seed}")))
                if problem := fault(load):
                    faults.append(f"{path.name}, seed {seed}: {problem}")
            path.write_bytes(whole)
    return faults


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 25
    found = campaign(range(count))
    sys.stdout.write("\n".join([*found, f"{8 * count} damaged files, {len(found)} faults\n"]))
    sys.exit(bool(found))
