"""Datasets in the layout of LeRobot, version 3.0 (https://github.com/huggingface/lerobot).

One task a skill. `observation.state` is what a robot measures and is told, `action` the answer of
the policy; every other feature is a column of its own name, which LeRobot's policies pass over.
Needs pyarrow, the extra `lerobot`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kiras_rl.dataset import ARRAYS, Dataset, DatasetError, Feature

if TYPE_CHECKING:
    import pyarrow as pa

VERSION = "v3.0"  # CODEBASE_VERSION of lerobot 0.4.0 to 0.4.4
CHUNK_SIZE = 1000  # files a folder, at most
DATA_FILE_MB = 100  # of frames a file; an episode is never split
_PATH = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_EPISODES = "meta/episodes/chunk-000/file-000.parquet"
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}

STATE = "observation.state"
STATE_PARTS = ("projected_gravity", "base_ang_vel_b", "joint_pos", "joint_vel", "command")
"""Features that make up the state, as far as the dataset has them."""

_LABELS = {"episode": "episode_index", "skill": "task_index"}
_LABELS |= {"done": "next.done", "fallen": "next.fallen"}
"""Columns of the labels of a frame."""


def require_pyarrow() -> None:
    """Check that parquet files can be read and written.

    Raises:
        DatasetError: If pyarrow is not installed.
    """
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError:
        raise DatasetError(
            "the LeRobot format needs pyarrow: pip install 'kiras-rl[lerobot]', or use npz"
        ) from None


def write(dataset: Dataset, folder: Path) -> None:
    """Write data and metadata into a folder.

    Raises:
        DatasetError: If pyarrow is missing, or the rate is no whole number.
    """
    require_pyarrow()
    fps = round(dataset.rate)
    if abs(dataset.rate - fps) > 1e-6:
        raise DatasetError(f"LeRobot counts whole frames a second, not {dataset.rate:g}: use npz")
    columns = _columns(dataset, fps)
    starts = np.flatnonzero(np.diff(dataset.episode, prepend=-1))
    stops = np.append(starts[1:], len(dataset))
    files = _deal(starts, stops, sum(array.nbytes for array in columns.values()) / len(dataset))
    _write_data(columns, starts, stops, files, folder)
    _write_episodes(dataset, columns, starts, stops, files, folder / _EPISODES)
    _write_tasks(dataset.skills, folder / "meta" / "tasks.parquet")
    _write_json(_statistics(columns), folder / "meta" / "stats.json")
    _write_json(_info(dataset, columns, fps), folder / "meta" / "info.json")


def read(folder: Path, features: Mapping[str, Feature]) -> dict[str, np.ndarray]:
    """Return features and labels of a dataset that `write` has written.

    Raises:
        DatasetError: If pyarrow or the data are missing, or the data are not whole.
    """
    require_pyarrow()
    import pyarrow as pa
    import pyarrow.parquet as pq

    paths = sorted((folder / "data").glob("*/*.parquet"))
    if not paths:
        raise DatasetError(f"{folder} holds no data: neither {ARRAYS} nor data/*/*.parquet")
    try:
        table = pa.concat_tables([pq.read_table(path) for path in paths])
        arrays = {name: _array(table[name]) for name in table.column_names}
    except (OSError, pa.ArrowException) as error:
        raise DatasetError(f"{folder / 'data'} is not whole: {error}") from None
    for label, column in _LABELS.items():
        if column in arrays:
            arrays[label] = arrays.pop(column)
    parts = _state_parts(features)
    if STATE in arrays:
        edges = np.cumsum([len(features[name].names) for name in parts])[:-1]
        arrays |= zip(parts, np.split(arrays[STATE], edges, axis=1), strict=True)
    return {
        name: array[:, None] if name in features and array.ndim == 1 else array
        for name, array in arrays.items()
    }


def _state_parts(features: Mapping[str, Feature]) -> list[str]:
    return [name for name in STATE_PARTS if name in features]


def _columns(dataset: Dataset, fps: int) -> dict[str, np.ndarray]:
    """Return every column by name, (M, K); a column of single numbers has K = 1."""
    parts = _state_parts(dataset.features)
    columns = {STATE: np.concatenate([dataset[name] for name in parts], axis=1)} if parts else {}
    columns |= {name: array for name, array in dataset.values.items() if name not in parts}
    index = np.arange(len(dataset))
    starts = np.flatnonzero(np.diff(dataset.episode, prepend=-1))
    frame = index - starts[dataset.episode]
    numbers = {"timestamp": (frame / fps).astype(np.float32), "frame_index": frame, "index": index}
    numbers |= {column: getattr(dataset, label) for label, column in _LABELS.items()}
    return columns | {name: array[:, None] for name, array in numbers.items()}


def _deal(starts: np.ndarray, stops: np.ndarray, frame_bytes: float) -> np.ndarray:
    """Return the number of the data file of each episode, (episodes,)."""
    files, used = [], 0.0
    for size in (stops - starts) * frame_bytes / 1e6:
        full = bool(files) and used + size > DATA_FILE_MB
        files.append(files[-1] + full if files else 0)
        used = size if full else used + size
    return np.array(files)


def _write_data(
    columns: dict[str, np.ndarray],
    starts: np.ndarray,
    stops: np.ndarray,
    files: np.ndarray,
    folder: Path,
) -> None:
    """Write the frames, one row group an episode, as LeRobot does."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pa.table({name: _arrow(array) for name, array in columns.items()})
    for file in np.unique(files):
        chunk = {"chunk_index": file // CHUNK_SIZE, "file_index": file % CHUNK_SIZE}
        path = folder / "data" / _PATH.format(**chunk)
        path.parent.mkdir(parents=True, exist_ok=True)
        with pq.ParquetWriter(path, table.schema) as writer:
            for episode in np.flatnonzero(files == file):
                start, stop = starts[episode], stops[episode]
                writer.write_table(table.slice(start, stop - start))


def _write_episodes(
    dataset: Dataset,
    columns: dict[str, np.ndarray],
    starts: np.ndarray,
    stops: np.ndarray,
    files: np.ndarray,
    path: Path,
) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows = []
    for start, stop, file in zip(starts.tolist(), stops.tolist(), files.tolist(), strict=True):
        statistics = _statistics({name: array[start:stop] for name, array in columns.items()})
        rows.append(
            {
                "episode_index": len(rows),
                "tasks": [dataset.skills[dataset.skill[start]]],
                "length": stop - start,
                "data/chunk_index": file // CHUNK_SIZE,
                "data/file_index": file % CHUNK_SIZE,
                "dataset_from_index": start,
                "dataset_to_index": stop,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
                **dict(_flatten("stats", statistics)),
            }
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.Table.from_pylist(rows), path)


def _write_tasks(skills: tuple[str, ...], path: Path) -> None:
    """Write the table of tasks; pandas, with which LeRobot reads it, finds the name as index."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pa.table({"task_index": list(range(len(skills))), "task": list(skills)})
    types = {"task_index": ("int64", "int64"), "task": ("unicode", "object")}
    described = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": stored}
        | {"metadata": None}
        for name, (kind, stored) in types.items()
    ]
    pandas = {"index_columns": ["task"], "column_indexes": [], "columns": described}
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}), path)


def _statistics(columns: dict[str, np.ndarray]) -> dict[str, dict[str, list]]:
    """Return what LeRobot normalises by: of each column its spread over the frames."""
    statistics = {}
    for name, array in columns.items():
        array = array.astype(np.float64)
        quantiles = np.quantile(array, list(_QUANTILES.values()), axis=0).tolist()
        statistics[name] = {
            "min": array.min(axis=0).tolist(),
            "max": array.max(axis=0).tolist(),
            "mean": array.mean(axis=0).tolist(),
            "std": array.std(axis=0).tolist(),
            "count": [len(array)],
            **dict(zip(_QUANTILES, quantiles, strict=True)),
        }
    return statistics


def _info(dataset: Dataset, columns: dict[str, np.ndarray], fps: int) -> dict[str, Any]:
    names = {name: list(feature.names) for name, feature in dataset.features.items()}
    names[STATE] = [f"{part}.{x}" for part in _state_parts(dataset.features) for x in names[part]]
    return {
        "codebase_version": VERSION,
        "robot_type": dataset.robot,
        "total_episodes": dataset.num_episodes,
        "total_frames": len(dataset),
        "total_tasks": len(dataset.skills),
        "chunks_size": CHUNK_SIZE,
        "data_files_size_in_mb": DATA_FILE_MB,
        "video_files_size_in_mb": 500,  # LeRobot's own; there are no videos
        "fps": fps,
        "splits": {"train": f"0:{dataset.num_episodes}"},
        "data_path": f"data/{_PATH}",
        "video_path": None,
        "features": {
            name: {
                "dtype": str(array.dtype),
                "shape": [array.shape[1]],
                "names": names.get(name),
            }
            for name, array in columns.items()
        },
    }


def _arrow(array: np.ndarray) -> pa.Array:
    """Return (M, K) as M lists of K numbers, or M numbers."""
    import pyarrow as pa

    flat = pa.array(array.reshape(-1))
    return flat if array.shape[1] == 1 else pa.FixedSizeListArray.from_arrays(flat, array.shape[1])


def _array(column: pa.ChunkedArray) -> np.ndarray:
    """Return a column as (M, K), or as (M,) where it holds single numbers."""
    import pyarrow as pa

    width = column.type.list_size if pa.types.is_fixed_size_list(column.type) else 0
    flat = column.combine_chunks()
    if not width:
        return flat.to_numpy(zero_copy_only=False)
    return flat.flatten().to_numpy(zero_copy_only=False).reshape(-1, width)


def _flatten(name: str, tree: object) -> Iterator[tuple[str, object]]:
    if not isinstance(tree, dict):
        yield name, tree
        return
    for key, branch in tree.items():
        yield from _flatten(f"{name}/{key}", branch)


def _write_json(content: dict[str, Any], path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
