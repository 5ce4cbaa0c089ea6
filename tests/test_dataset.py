"""Datasets that can be counted by hand, through both formats and back."""

from __future__ import annotations

import dataclasses
import json
import sys

import numpy as np
import pyarrow.parquet as pq
import pytest

from kiras_rl import lerobot
from kiras_rl.dataset import (
    FORMATS,
    LABELS,
    Dataset,
    DatasetError,
    Feature,
    load_dataset,
    save_dataset,
)

LENGTHS = (3, 1, 2)  # frames of the episodes; the second one falls at once
FRAMES = sum(LENGTHS)


def make(**changes):
    """Return three episodes: of walk, crawl and walk."""
    numbers = np.arange(FRAMES, dtype=np.float32)
    values = {
        "imitation": np.stack([numbers, -numbers], axis=1),
        "joint_pos": np.stack([numbers, 10 * numbers, 100 * numbers], axis=1),
        "command": np.stack([0 * numbers + 0.5], axis=1),
        "base_height": 0.1 * numbers[:, None],
        "foot_contact": np.stack([numbers > 1, numbers > 2], axis=1),
        "action": -np.stack([numbers, numbers, numbers], axis=1),
    }
    fields = {
        "robot": "solo8",
        "rate": 50.0,
        "skills": ("walk", "crawl"),
        "features": {
            name: Feature(tuple(f"{name}_{k}" for k in range(array.shape[1])), ("m",))
            for name, array in values.items()
        },
        "values": values,
        "episode": np.array([0, 0, 0, 1, 2, 2]),
        "skill": np.array([0, 0, 0, 1, 0, 0]),
        "done": np.array([0, 0, 1, 1, 0, 1], bool),
        "fallen": np.array([0, 0, 0, 1, 0, 0], bool),
        "provenance": {"seed": 3, "versions": {"numpy": "2"}},
    }
    return Dataset(**(fields | changes))


@pytest.fixture
def dataset():
    return make()


@pytest.fixture(params=FORMATS)
def saved(request, dataset, tmp_path):
    """The folder of a dataset in one of the formats."""
    save_dataset(dataset, tmp_path / "new" / "data", [request.param])
    return tmp_path / "new" / "data"


def assert_same(one, other):
    for field in ("robot", "rate", "skills", "features", "provenance"):
        assert getattr(one, field) == getattr(other, field)
    pairs = [(getattr(one, name), getattr(other, name)) for name in LABELS]
    pairs += [(one[name], other[name]) for name in one.features]
    for a, b in pairs:
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


# --- in memory -----------------------------------------------------------------------------------


def test_a_feature_comes_by_episode(dataset):
    assert dataset.num_episodes == 3
    assert len(dataset) == FRAMES
    assert [part[:, 0].tolist() for part in dataset.episodes("joint_pos")] == [
        [0, 1, 2],
        [3],
        [4, 5],
    ]
    assert [part[0, 0] for part in dataset.episodes("joint_pos", "crawl")] == [3]


def test_transitions_stay_within_an_episode_and_a_skill(dataset):
    pairs = dataset.transitions()
    assert list(pairs) == ["walk", "crawl"]
    before, after = pairs["walk"]
    assert before.tolist() == [[0, 0], [1, -1], [4, -4]]
    assert after.tolist() == [[1, -1], [2, -2], [5, -5]]
    assert [half.shape for half in pairs["crawl"]] == [(0, 2), (0, 2)]


def test_a_change_of_skill_within_an_episode_is_no_transition():
    switched = make(skill=np.array([0, 0, 1, 1, 1, 1]))
    assert switched.transitions()["walk"][0].tolist() == [[0, 0]]
    assert switched.transitions()["crawl"][0].tolist() == [[4, -4]]


@pytest.mark.parametrize(
    ("read", "said"),
    [
        (lambda d: d["torque"], "no feature 'torque'; there are: imitation, joint_pos, command"),
        (lambda d: d.episodes("action", "trot"), "no skill 'trot'; there are: walk, crawl"),
    ],
)
def test_unknown_names_are_one_line(dataset, read, said):
    with pytest.raises(DatasetError, match=said):
        read(dataset)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"episode": np.zeros(0, int)}, "without episodes"),
        ({"episode": np.array([0, 0, 0, 2, 3, 3])}, "follow each other"),
        ({"episode": np.array([0, 0, 0, 1, 0, 0])}, "follow each other"),
        ({"done": np.array([0, 1, 1, 1, 0, 1], bool)}, "last frame of each episode"),
        ({"skill": np.zeros(4, int)}, r"skill has the shape \(4,\), not \(6,\)"),
        ({"features": {"a": Feature(("x",), ("m",))}}, "feature a has no values"),
    ],
)
def test_parts_that_do_not_fit_are_refused(changes, said):
    with pytest.raises(DatasetError, match=said):
        make(**changes)


# --- on disk -------------------------------------------------------------------------------------


def test_what_is_read_is_what_was_written(saved, dataset):
    assert_same(load_dataset(saved), dataset)
    assert [path.name for path in saved.parent.iterdir()] == ["data"]  # nothing is left beside it


def test_one_folder_can_hold_both_formats(dataset, tmp_path):
    save_dataset(dataset, tmp_path / "both", FORMATS)
    assert_same(load_dataset(tmp_path / "both"), dataset)
    (tmp_path / "both" / "dataset.npz").unlink()
    assert_same(load_dataset(tmp_path / "both"), dataset)


def test_an_empty_folder_may_be_filled_and_a_full_one_not(saved, dataset, tmp_path):
    (tmp_path / "empty").mkdir()
    save_dataset(dataset, tmp_path / "empty")
    before = {path: path.read_bytes() for path in saved.rglob("*") if path.is_file()}
    with pytest.raises(DatasetError, match="holds files, which are not overwritten"):
        save_dataset(make(robot="go1"), saved)
    assert {path: path.read_bytes() for path in saved.rglob("*") if path.is_file()} == before
    (tmp_path / "file").write_text("a letter")
    with pytest.raises(DatasetError, match="is a file"):
        save_dataset(dataset, tmp_path / "file")


def test_an_empty_folder_stays_the_one_that_it_is(dataset, tmp_path):
    """It may be where another disk is mounted, whose place nothing can take."""
    volume = tmp_path / "volume"
    volume.mkdir()
    before = volume.stat().st_ino
    save_dataset(dataset, volume)
    assert volume.stat().st_ino == before
    assert len(load_dataset(volume).done) == FRAMES


@pytest.mark.parametrize("name", FORMATS)
def test_an_interrupt_leaves_nothing(name, tmp_path):
    class Interrupt:
        def __str__(self):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        save_dataset(make(provenance={"who": Interrupt()}), tmp_path / "data", [name])
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_dataset_is_one_line(tmp_path):
    with pytest.raises(DatasetError, match=r"no dataset at .*: kiras-collect writes"):
        load_dataset(tmp_path / "nowhere")
    (tmp_path / "dataset.json").write_text("[1]")
    with pytest.raises(DatasetError, match="not the description of a dataset"):
        load_dataset(tmp_path)
    (tmp_path / "dataset.json").write_text('{"format": 9}')
    with pytest.raises(DatasetError, match="format 9, this version reads 1"):
        load_dataset(tmp_path)


@pytest.mark.parametrize("name", FORMATS)
def test_a_damaged_dataset_is_one_line(name, dataset, tmp_path):
    save_dataset(dataset, tmp_path / "data", [name])
    (file,) = [*(tmp_path / "data").glob("*.npz"), *(tmp_path / "data" / "data").rglob("*.parquet")]
    file.write_bytes(file.read_bytes()[:-30])
    with pytest.raises(DatasetError, match="is not whole"):
        load_dataset(tmp_path / "data")
    file.unlink()
    with pytest.raises(DatasetError, match="holds no data"):
        load_dataset(tmp_path / "data")


# --- LeRobot -------------------------------------------------------------------------------------


@pytest.fixture
def folder(dataset, tmp_path):
    save_dataset(dataset, tmp_path / "data", ["lerobot"])
    return tmp_path / "data"


def read_table(path):
    return pq.read_table(path).to_pydict()


def test_lerobot_finds_its_columns(folder):
    data = read_table(folder / "data" / "chunk-000" / "file-000.parquet")
    assert data["observation.state"][2] == [2, 20, 200, 0.5]  # joint_pos and command
    assert data["action"][1] == [-1, -1, -1]
    assert data["base_height"][1] == pytest.approx(0.1)
    assert data["frame_index"] == [0, 1, 2, 0, 0, 1]
    assert data["timestamp"] == pytest.approx([0, 0.02, 0.04, 0, 0, 0.02])
    assert data["index"] == list(range(6))
    assert data["episode_index"] == [0, 0, 0, 1, 2, 2]
    assert data["task_index"] == [0, 0, 0, 1, 0, 0]
    assert data["next.done"] == [False, False, True, True, False, True]
    assert "joint_pos" not in data


def test_lerobot_is_told_what_there_is(folder):
    info = json.loads((folder / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    totals = ("total_episodes", "total_frames", "total_tasks", "fps", "robot_type")
    assert [info[name] for name in totals] == [3, 6, 2, 50, "solo8"]
    assert info["splits"] == {"train": "0:3"}
    place = info["data_path"].format(chunk_index=0, file_index=0)
    assert (folder / place).is_file()
    assert info["features"]["observation.state"] == {
        "dtype": "float32",
        "shape": [4],
        "names": [*(f"joint_pos.joint_pos_{k}" for k in range(3)), "command.command_0"],
    }
    assert info["features"]["foot_contact"]["dtype"] == "bool"
    assert info["features"]["index"] == {"dtype": "int64", "shape": [1], "names": None}


def test_lerobot_is_told_of_every_episode(folder):
    episodes = read_table(folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    assert episodes["length"] == [3, 1, 2]
    assert episodes["tasks"] == [["walk"], ["crawl"], ["walk"]]
    assert episodes["dataset_from_index"] == [0, 3, 4]
    assert episodes["dataset_to_index"] == [3, 4, 6]
    assert episodes["stats/imitation/mean"][2] == [4.5, -4.5]
    tasks = pq.read_table(folder / "meta" / "tasks.parquet")
    assert tasks.to_pydict() == {"task_index": [0, 1], "task": ["walk", "crawl"]}
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]


def test_statistics_are_those_of_all_frames(folder):
    stats = json.loads((folder / "meta" / "stats.json").read_text())["imitation"]
    assert (stats["min"], stats["max"], stats["count"]) == ([0, -5], [5, 0], [6])
    assert (stats["mean"], stats["q50"]) == ([2.5, -2.5], [2.5, -2.5])
    # the variance of 0 to 5 is (6^2 - 1) / 12
    assert stats["std"] == pytest.approx([(35 / 12) ** 0.5] * 2)


def test_large_data_are_dealt_to_several_files(dataset, tmp_path, monkeypatch):
    frame_bytes = 4 * (4 + 2 + 1 + 3 + 1) + 2 + 4 * 8 + 2  # floats, contacts, integers, flags
    monkeypatch.setattr(lerobot, "DATA_FILE_MB", 4.5 * frame_bytes / 1e6)
    save_dataset(dataset, tmp_path / "data", ["lerobot"])
    files = sorted((tmp_path / "data" / "data").rglob("*.parquet"))
    assert [len(pq.read_table(file)) for file in files] == [4, 2]  # whole episodes
    table = read_table(tmp_path / "data" / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    assert table["data/file_index"] == [0, 0, 1]
    assert_same(load_dataset(tmp_path / "data"), dataset)


def test_lerobot_needs_whole_frames_a_second(tmp_path):
    with pytest.raises(DatasetError, match=r"not 33\.3: use npz"):
        save_dataset(make(rate=33.3), tmp_path / "data", ["lerobot"])
    assert list(tmp_path.iterdir()) == []


def test_without_pyarrow_it_is_one_line(folder, dataset, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    wanted = r"needs pyarrow: pip install 'kiras-rl\[lerobot\]'"
    with pytest.raises(DatasetError, match=wanted):
        save_dataset(dataset, tmp_path / "other", ["lerobot"])
    with pytest.raises(DatasetError, match=wanted):
        load_dataset(folder)
    save_dataset(dataset, tmp_path / "other")
    assert_same(load_dataset(tmp_path / "other"), dataset)


def test_a_feature_that_is_no_part_of_the_state_may_be_missing(tmp_path):
    dataset = make()
    small = dataclasses.replace(
        dataset,
        features={"imitation": dataset.features["imitation"]},
        values={"imitation": dataset["imitation"]},
    )
    save_dataset(small, tmp_path / "data", ["lerobot"])
    assert_same(load_dataset(tmp_path / "data"), small)
