"""Checkpoint files: whole or not at all, read without running what is in them."""

from __future__ import annotations

import os
import pickle
import re
import resource

import pytest
import torch

from kiras_rl import checkpoint
from kiras_rl.checkpoint import CheckpointError, find_checkpoint, load_checkpoint, save_checkpoint
from kiras_rl.files import remove_leftovers
from kiras_rl.models.exported import ExportedPolicy

CONTENT = {"learner": {"weights": torch.arange(1000.0)}, "iteration": 7, "infos": None}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "checkpoints" / "latest.pt"


@pytest.fixture
def saved(path):
    save_checkpoint(path, CONTENT)
    return path


def refusal(path):
    """Return the message with which a file is refused: always one line that names it."""
    with pytest.raises(CheckpointError) as caught:
        load_checkpoint(path)
    message = str(caught.value)
    assert "\n" not in message and str(path) in message
    return message


def test_what_is_written_is_read(saved):
    content = load_checkpoint(saved)
    assert torch.equal(content["learner"]["weights"], CONTENT["learner"]["weights"])
    assert (content["iteration"], content["infos"]) == (7, None)
    assert content["versions"]["torch"] == torch.__version__


def test_a_failed_write_leaves_the_old_file_and_nothing_else(saved):
    before = saved.read_bytes()
    with pytest.raises((AttributeError, pickle.PicklingError)):
        save_checkpoint(saved, {"learner": lambda: None})
    assert saved.read_bytes() == before
    assert [p.name for p in saved.parent.iterdir()] == ["latest.pt"]


def test_a_write_replaces_the_file_at_once(saved, monkeypatch):
    def crash(*_):
        raise OSError("the disk is full")

    before = saved.read_bytes()
    monkeypatch.setattr(os, "fsync", crash)
    with pytest.raises(OSError, match="disk is full"):
        save_checkpoint(saved, CONTENT | {"iteration": 8})
    assert saved.read_bytes() == before


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.9, 0.999])
def test_a_truncated_file_is_refused(saved, share):
    whole = saved.read_bytes()
    saved.write_bytes(whole[: int(share * len(whole))])
    message = refusal(saved)
    assert "is not a whole KiRAS checkpoint" in message
    assert f"other checkpoints are in {saved.parent}" in message


@pytest.mark.parametrize(
    "content", [b"seed: 1\n", b"\x89PNG\r\n\x1a\n" + bytes(100), bytes(range(256))], ids=len
)
def test_a_foreign_file_is_refused(tmp_path, content):
    path = tmp_path / "some.file"
    path.write_bytes(content)
    assert "is not a whole KiRAS checkpoint" in refusal(path)


@pytest.mark.parametrize("content", [{"model": torch.zeros(2)}, [1, 2], torch.zeros(2)], ids=str)
def test_another_project_s_checkpoint_is_refused(tmp_path, content):
    path = tmp_path / "model.pt"
    torch.save(content, path)
    assert refusal(path) == f"{path} is a PyTorch file, but not a KiRAS checkpoint"


def test_another_format_is_refused(saved):
    torch.save(load_checkpoint(saved) | {"format": 99}, saved)
    assert re.search(r"has checkpoint format 99, this version reads \d+$", refusal(saved))


class Bomb:
    """Makes a folder when it is unpickled."""

    def __reduce__(self):
        """Unpickle by calling os.mkdir."""
        return os.mkdir, ("bomb",)


def test_a_file_that_would_run_code_is_refused(saved, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.save(load_checkpoint(saved) | {"infos": Bomb()}, saved)
    assert "is not a whole KiRAS checkpoint" in refusal(saved)
    assert not (tmp_path / "bomb").exists()


def test_of_a_run_the_asked_for_checkpoint_is_taken_or_the_other(saved):
    run = saved.parent.parent
    assert find_checkpoint(run) == saved  # there is no best one yet
    best = saved.with_name("best.pt")
    save_checkpoint(best, CONTENT)
    assert find_checkpoint(run) == best
    assert find_checkpoint(run, prefer=checkpoint.LATEST) == saved
    assert find_checkpoint(saved) == saved


def test_where_nothing_is_nothing_is_found(tmp_path):
    assert f"no checkpoint at {tmp_path / 'x.pt'}" in refusal(tmp_path / "x.pt")
    with pytest.raises(CheckpointError, match=r"does not exist: give a run folder or a checkpoint"):
        find_checkpoint(tmp_path / "run")
    with pytest.raises(CheckpointError, match=r"holds no checkpoint: expected checkpoints/latest"):
        find_checkpoint(tmp_path)


def test_a_policy_is_rebuilt_from_its_shape(path, make_metadata, make_policy):
    policy = make_policy(make_metadata())
    rebuilt_from = {
        "learner": {},
        "policy": policy.state_dict(),
        "policy_shape": policy.shape(),
        "description": {"robot": "solo8"},
    }
    save_checkpoint(path, rebuilt_from)
    rebuilt, description = checkpoint.load_policy(path)
    assert isinstance(rebuilt, ExportedPolicy)
    assert description == {"robot": "solo8"}
    frame = policy.shape()["estimator"]["proprio_dim"]
    proprio, history = torch.randn(3, frame), torch.randn(3, 4 * frame)
    for mine, its in zip(policy(proprio, history), rebuilt(proprio, history), strict=True):
        assert torch.equal(mine, its)


def test_an_estimator_of_an_unknown_class_is_refused_in_one_line(path, make_metadata, make_policy):
    policy = make_policy(make_metadata())
    shape = policy.shape()
    shape["estimator"]["class_name"] = "nowhere.at_all:Estimator"
    content = {"policy_shape": shape, "policy": policy.state_dict(), "description": {}}
    save_checkpoint(path, {"learner": {}} | content)
    with pytest.raises(CheckpointError) as caught:
        checkpoint.load_policy(path)
    assert str(caught.value).startswith(f"{path}: policy_shape.estimator.class_name=nowhere.at_all")
    assert "\n" not in str(caught.value)


def test_what_the_disk_does_not_give_back_is_found_when_it_is_written(saved, monkeypatch):
    before = saved.read_bytes()
    sync = os.fsync

    def tear(file):
        os.pwrite(file, b"torn", 20)
        sync(file)

    monkeypatch.setattr(os, "fsync", tear)
    with pytest.raises(OSError, match=r"was not written: .* does not read as it was written"):
        save_checkpoint(saved, {"learner": {"x": torch.ones(5)}})
    assert saved.read_bytes() == before
    assert [file.name for file in saved.parent.iterdir()] == [saved.name]


def test_a_full_disk_is_one_line_and_leaves_the_old_file(saved):
    before = saved.read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))  # no file may become larger
    try:
        with pytest.raises(OSError, match="was not written: ") as caught:
            save_checkpoint(saved, {"learner": {"x": torch.ones(100_000)}})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "\n" not in str(caught.value)
    assert "File too large" in str(caught.value)
    assert saved.read_bytes() == before
    assert [file.name for file in saved.parent.iterdir()] == [saved.name]


def test_what_killed_processes_began_is_removed_and_nothing_else(saved):
    folder = saved.parent
    (folder / ".latest.pt.123.tmp").write_bytes(b"a part")
    (folder / ".456.tmp").mkdir()  # a dataset that is being written
    (folder / ".lock").touch()
    remove_leftovers(folder)
    assert sorted(path.name for path in folder.iterdir()) == [".456.tmp", ".lock", "latest.pt"]
