"""Recorded motion: frames of named features, on disk and in memory. Needs numpy alone.

Letters: M frames, K numbers of a feature, T frames of an episode.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kiras_rl.deploy.errors import PlainError

FORMAT = 1
FORMATS = ("npz", "lerobot")
HEADER, ARRAYS = "dataset.json", "dataset.npz"

LABELS = {"episode": np.int64, "skill": np.int64, "done": np.bool_, "fallen": np.bool_}
"""One number a frame, beside the features: names of fields of `Dataset`."""

Transitions = tuple[np.ndarray, np.ndarray]


class DatasetError(PlainError, ValueError):
    """A dataset that cannot be read or written; the message says why."""


@dataclass(frozen=True)
class Feature:
    """What the K numbers of a feature are called, and their units.

    A number that was scaled has its unit divided by the scale: "m / 10" counts tenths of a metre.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Dataset:
    """Episodes of one robot, one after the other.

    A frame is the end of a control step: what was measured there, before any reset or push, and
    the action with which the policy answered. The next frame of the episode is what became of it.

    Attributes:
        robot: Name of the robot.
        rate: Frames a second, Hz.
        skills: Names of the skills.
        features: What there is of every frame.
        values: The numbers of each feature, (M, K).
        episode: Number of the episode, from 0, (M,).
        skill: Index of the commanded skill, (M,).
        done: Last frames of their episodes, (M,).
        fallen: Frames whose next step ended in a fall, (M,); they are `done`, too.
        provenance: What made the dataset.

    Raises:
        DatasetError: If there are no frames, or the parts do not fit each other.
    """

    robot: str
    rate: float
    skills: tuple[str, ...]
    features: dict[str, Feature]
    values: dict[str, np.ndarray]
    episode: np.ndarray
    skill: np.ndarray
    done: np.ndarray
    fallen: np.ndarray
    provenance: dict[str, Any]

    def __post_init__(self) -> None:
        """Check shapes, so that nothing later has to."""
        count = len(self.episode)
        if not count:
            raise DatasetError("a dataset without episodes: there is not a single frame")
        for name in LABELS:
            _check_shape(name, getattr(self, name), (count,))
        for name, feature in self.features.items():
            if name not in self.values:
                raise DatasetError(f"feature {name} has no values")
            _check_shape(name, self.values[name], (count, len(feature.names)))
        steps = np.diff(self.episode)
        if self.episode[0] != 0 or not np.isin(steps, (0, 1)).all():
            raise DatasetError("episodes must follow each other, from 0")
        if not np.array_equal(np.append(steps == 1, True), self.done):
            raise DatasetError("`done` must mark the last frame of each episode, and no other")

    def __getitem__(self, name: str) -> np.ndarray:
        """Return a feature of all frames, (M, K).

        Raises:
            DatasetError: If there is none of this name.
        """
        if name not in self.values:
            raise DatasetError(f"no feature '{name}'; there are: {', '.join(self.features)}")
        return self.values[name]

    def __len__(self) -> int:
        """Return the number of frames, M."""
        return len(self.episode)

    @property
    def num_episodes(self) -> int:
        """Number of episodes."""
        return int(self.episode[-1]) + 1

    def episodes(self, name: str, skill: str | None = None) -> list[np.ndarray]:
        """Return a feature by episode, (T, K) each.

        Args:
            name: Of the feature.
            skill: Only episodes that begin in this skill.

        Raises:
            DatasetError: If there is no such feature or skill.
        """
        starts = np.flatnonzero(np.diff(self.episode, prepend=-1))
        parts = np.split(self[name], starts[1:])
        if skill is None:
            return parts
        wanted = self._index(skill)
        return [p for p, i in zip(parts, self.skill[starts], strict=True) if i == wanted]

    def transitions(self, name: str = "imitation") -> dict[str, Transitions]:
        """Return all pairs of consecutive frames of an episode, by skill.

        Args:
            name: Of the feature; Phi if not given.

        Returns:
            For each skill the feature before and after a control step, (pairs, K) each. A pair in
            which the skill changes belongs to none.

        Raises:
            DatasetError: If there is no such feature.
        """
        values = self[name]
        within = ~self.done[:-1] & (self.skill[:-1] == self.skill[1:])
        pairs = {}
        for index, skill in enumerate(self.skills):
            first = np.flatnonzero(within & (self.skill[:-1] == index))
            pairs[skill] = (values[first], values[first + 1])
        return pairs

    def _index(self, skill: str) -> int:
        if skill not in self.skills:
            raise DatasetError(f"no skill '{skill}'; there are: {', '.join(self.skills)}")
        return self.skills.index(skill)


def load_dataset(path: str | Path) -> Dataset:
    """Read a folder that kiras-collect has written, in either format.

    Raises:
        DatasetError: If there is no such dataset, or it is not whole.
    """
    folder = Path(path)
    header = _read_header(folder / HEADER)
    features = header["features"]
    if (folder / ARRAYS).is_file():
        arrays = _read_npz(folder / ARRAYS)
    else:
        from kiras_rl import lerobot

        arrays = lerobot.read(folder, features)
    missing = [name for name in (*LABELS, *features) if name not in arrays]
    if missing:
        raise DatasetError(f"{folder} lacks {', '.join(missing)}")
    return Dataset(
        **header,
        values={name: arrays[name] for name in features},
        episode=arrays["episode"],
        skill=arrays["skill"],
        done=arrays["done"],
        fallen=arrays["fallen"],
    )


def save_dataset(dataset: Dataset, path: str | Path, formats: Sequence[str] = ("npz",)) -> None:
    """Write a dataset as a folder, which is one only when it is whole: its description comes last.

    Args:
        dataset: What to write.
        path: The folder; new, or empty.
        formats: Of FORMATS.

    Raises:
        DatasetError: As `check_target`, or if a format cannot hold the dataset.
    """
    check_target(path, formats)
    folder = Path(path).resolve()
    is_new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    temporary = folder / f".{os.getpid()}.tmp"  # within: the folder may be another disk, mounted
    temporary.mkdir()
    try:
        _write_header(dataset, temporary / HEADER)
        if "npz" in formats:
            arrays: dict[str, Any] = {name: getattr(dataset, name) for name in LABELS}
            arrays |= dataset.values
            np.savez_compressed(temporary / ARRAYS, **arrays)
        if "lerobot" in formats:
            from kiras_rl import lerobot

            lerobot.write(dataset, temporary)
    except BaseException:
        shutil.rmtree(folder if is_new else temporary, ignore_errors=True)
        raise
    for part in sorted(temporary.iterdir(), key=lambda part: part.name == HEADER):
        part.replace(folder / part.name)
    temporary.rmdir()


def check_target(path: str | Path, formats: Sequence[str]) -> None:
    """Check that a dataset can be written to a folder, and leave everything as it is.

    Raises:
        DatasetError: If something is there already, nothing can be written there, or a format is
            unknown or needs a package.
    """
    folder = Path(path)
    if folder.is_dir() and any(folder.iterdir()):
        raise DatasetError(f"{folder} holds files, which are not overwritten: name a new folder")
    if folder.exists() and not folder.is_dir():
        raise DatasetError(f"{folder} is a file, which is not overwritten: name a new folder")
    _try_to_write(folder)
    unknown = [name for name in formats if name not in FORMATS]
    if unknown or not formats:
        given = ", ".join(unknown) or "none"
        raise DatasetError(f"format {given} was given; there are: {', '.join(FORMATS)}")
    if "lerobot" in formats:
        from kiras_rl import lerobot

        lerobot.require_pyarrow()


def _try_to_write(folder: Path) -> None:
    """Write a file where the dataset will lie, or in the first folder above that there is."""
    place = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    try:
        with tempfile.NamedTemporaryFile(dir=place) as file:
            file.write(b"x" * 4096)
    except OSError as error:
        raise DatasetError(f"{folder}: nothing can be written there ({error.strerror})") from None


def _check_shape(name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise DatasetError(f"{name} has the shape {array.shape}, not {shape}")


def _write_header(dataset: Dataset, path: Path) -> None:
    header = {
        "format": FORMAT,
        "robot": dataset.robot,
        "rate": dataset.rate,
        "skills": dataset.skills,
        "episodes": dataset.num_episodes,
        "frames": len(dataset),
        "features": {name: asdict(feature) for name, feature in dataset.features.items()},
        "provenance": dataset.provenance,
    }
    path.write_text(json.dumps(header, indent=1, default=str) + "\n", encoding="utf-8")


def _read_header(path: Path) -> dict[str, Any]:
    """Return the fields of `Dataset` that are no arrays."""
    if not path.is_file():
        raise DatasetError(f"no dataset at {path.parent}: kiras-collect writes a {HEADER} there")
    try:
        header = json.loads(path.read_text(encoding="utf-8"))
        if header["format"] != FORMAT:
            raise DatasetError(f"{path} has format {header['format']}, this version reads {FORMAT}")
        features = {
            name: Feature(tuple(item["names"]), tuple(item["units"]))
            for name, item in header["features"].items()
        }
        plain = {name: header[name] for name in ("robot", "rate", "provenance")}
        return plain | {"skills": tuple(header["skills"]), "features": features}
    except (json.JSONDecodeError, UnicodeDecodeError, TypeError, KeyError, AttributeError):
        raise DatasetError(f"{path} is not the description of a dataset") from None


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return dict(arrays)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise DatasetError(f"{path} is not whole: {error}") from None
