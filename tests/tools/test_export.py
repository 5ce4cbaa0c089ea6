"""kiras-export: a checkpoint becomes one policy file, with what one wants to know about it."""

from __future__ import annotations

import pytest
import torch

from kiras_rl.checkpoint import save_checkpoint
from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.models.exported import build_policy
from kiras_rl.tools import play
from kiras_rl.tools.export import main


@pytest.fixture
def run(make_metadata, tmp_path):
    """Make a run folder with one checkpoint, holding what exporting reads of it."""
    metadata = make_metadata()
    estimator = {
        "proprio_dim": metadata.frame_size,
        "history_length": metadata.history_length,
        "num_skills": len(metadata.skills),
        "latent_dim": 4,
        "encoder_dims": [32],
        "decoder_dims": [32],
    }
    actor = [(metadata.frame_size + 3 + 4, 32), (32, metadata.num_joints)]
    shape = {"estimator": estimator, "actor": actor}
    content = {
        "learner": {},
        "policy_shape": shape,
        "policy": build_policy(shape).state_dict(),
        "description": metadata.to_dict(),
    }
    save_checkpoint(tmp_path / "run" / "checkpoints" / "latest.pt", content)
    return tmp_path / "run"


def test_a_run_gets_its_policy_file(run, make_metadata, capsys):
    assert main([str(run)]) == 0
    assert OnboardPolicy(run / "policy.onnx").metadata == make_metadata()
    out = capsys.readouterr().out
    for word in ("kB", "1000 random inputs", "ms median", "p99", "solo8", "walk, crawl, stilt"):
        assert word in out


def test_a_checkpoint_gets_a_file_beside_it(run):
    assert main([str(run / "checkpoints" / "latest.pt")]) == 0
    assert (run / "checkpoints" / "latest.onnx").is_file()


def test_the_file_goes_where_it_is_told(run, tmp_path):
    assert main([str(run), "--out", str(tmp_path / "new" / "a.onnx")]) == 0
    assert (tmp_path / "new" / "a.onnx").is_file()
    assert not (run / "policy.onnx").exists()


def test_a_checkpoint_is_played_without_leaving_a_file(run, capsys):
    assert play.main([str(run), "--script=walk:0.4:0.3"]) == 0
    assert "solo8, 0.4 s" in capsys.readouterr().out
    assert not list(run.rglob("*.onnx"))


@pytest.fixture
def error_of(capsys):
    """Run the command, and return the one line that it says on stderr."""

    def run_command(path):
        assert main([str(path)]) == 2
        err = capsys.readouterr().err
        assert err.startswith("error: ")
        assert err.count("\n") == 1
        return err

    return run_command


def test_a_run_without_checkpoints_is_one_line(error_of, tmp_path):
    assert "holds none of checkpoints/best.pt, checkpoints/latest.pt" in error_of(tmp_path)


def test_a_damaged_checkpoint_is_one_line(error_of, tmp_path):
    (tmp_path / "a.pt").write_text("a letter")
    assert "is not a whole KiRAS checkpoint" in error_of(tmp_path / "a.pt")


def test_a_foreign_checkpoint_is_one_line(error_of, tmp_path):
    torch.save({"weights": torch.zeros(2)}, tmp_path / "a.pt")
    assert "not a KiRAS checkpoint" in error_of(tmp_path / "a.pt")


def test_a_policy_file_is_already_exported(error_of, still_file):
    assert "is none of: run folder, .pt" in error_of(still_file)
