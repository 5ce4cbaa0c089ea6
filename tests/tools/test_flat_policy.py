"""kiras-train --flat: terrain finetuning that begins from an earlier skill learning."""

from __future__ import annotations

import pytest
import torch

from kiras_rl.checkpoint import load_checkpoint, save_checkpoint
from kiras_rl.config import load_config
from kiras_rl.phases import FINETUNING
from kiras_rl.tools.train import main
from kiras_rl.tools.training.run import begin, resume

TINY = [
    *("num_envs=4", "evaluation.interval=0", "iterations=7", "finetuning.iterations=1"),
    *(f"finetuning.env.terrain.types.{name}=null" for name in ("slopes", "bars", "footholds")),
]


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """A few worlds are faster on one thread, much faster on a busy machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """The folder of a skill learning of one iteration, with its best policy."""
    given = ["num_envs=8", "finetuning=null", "iterations=1"]
    runner = begin(load_config("smoke", given))
    runner.run_dir = tmp_path_factory.mktemp("learned")
    assert runner.learn()
    return runner.run_dir


def test_finetuning_begins_from_the_best_policy(learned, tmp_path, capsys):
    best = learned / "checkpoints" / "best.pt"
    argv = ["--cfg", "smoke", "--runs", str(tmp_path), "--flat", str(learned), *TINY]
    assert main(argv) == 0
    out = capsys.readouterr().out
    assert f"solo8: finetuning at iteration 7, from {best} (0.0 M steps of skill learning)" in out
    assert "4 worlds, native physics, cpu | 1 iterations, 0.0 M steps" in out
    assert "8/8 |" in out
    (run,) = (tmp_path / "smoke").iterdir()
    assert (run / "policy.onnx").exists() and (run / "curves.png").exists()
    assert (run / "checkpoints" / "flat.pt").read_bytes() == best.read_bytes()

    latest = run / "checkpoints" / "latest.pt"
    source, content = load_checkpoint(best), load_checkpoint(latest)
    assert (content["phase"], content["iteration"]) == ("finetuning", 7 + 1)
    reference, policy = content["learner"]["parts"]["retention"], source["policy"]
    assert reference.keys() == policy.keys()
    assert all(torch.equal(reference[name], policy[name]) for name in policy)
    provenance = content["description"]["provenance"]
    assert provenance["begun_from"] == str(best)
    assert provenance["steps"] == 1 * 24 * 8 + 1 * 24 * 4
    assert content["seconds"] > source["seconds"]

    again = resume(latest, ["finetuning.iterations=2"])
    assert again.current_learning_iteration == 8
    assert again.describe_policy()["provenance"]["begun_from"] == str(best)
    assert again.steps == provenance["steps"]


# --- what cannot be ------------------------------------------------------------------------------


def refusal(capsys, *argv):
    """Return the one line with which a command ends."""
    assert main([*argv]) == 2
    out, err = capsys.readouterr()
    assert err.startswith("error: ") and err.count("\n") == 1
    assert out == ""
    return err


@pytest.mark.parametrize(
    ("override", "part"),
    [
        ("finetuning=null", "which this configuration leaves out: finetuning=null"),
        ("robot=go1", "does not fit this configuration: other robot (solo8 there, go1 here)"),
        ("env.observations.history_length=3", "other history_length (4 there, 3 here)"),
        ("env.observations.proprio.base_ang_vel={}", "configuration: other observation; finetune"),
        ("env.observations.critic.height_scan=null", "other sizes of the critic"),
    ],
)
def test_a_policy_that_does_not_fit_is_refused(learned, override, part, tmp_path, capsys):
    argv = ["--cfg", "smoke", "--runs", str(tmp_path), "--flat", str(learned), *TINY]
    assert part in refusal(capsys, *argv, override)
    assert list(tmp_path.iterdir()) == []


def test_a_checkpoint_that_holds_no_flat_policy_is_refused(learned, tmp_path, capsys):
    content = load_checkpoint(learned / "checkpoints" / "best.pt")
    skills = [*content["skills"][1:], content["skills"][0]]
    description = content["description"] | {"skills": skills}
    save_checkpoint(tmp_path / "skills.pt", content | {"description": description})
    save_checkpoint(tmp_path / "rough.pt", content | {"phase": FINETUNING})
    save_checkpoint(tmp_path / "early.pt", content | {"best_networks": None})
    runs = tmp_path / "runs"
    for path, part in (
        (tmp_path / "nothing", "does not exist: give a run folder or a checkpoint file"),
        (tmp_path / "rough.pt", "is of the phase finetuning: give a checkpoint of"),
        (tmp_path / "skills.pt", "does not fit this configuration: other skills"),
        (tmp_path / "early.pt", "was written before the first evaluation"),
    ):
        argv = ["--cfg", "smoke", "--runs", str(runs), *TINY, "--flat", str(path)]
        assert part in refusal(capsys, *argv)
    assert not runs.exists()


@pytest.mark.parametrize("option", ["--resume", "--sweep"])
def test_it_goes_with_a_new_run_alone(option, capsys):
    message = refusal(capsys, option, "x", "--flat", "y")
    assert f"--flat begins a new run: give it with --cfg, not with {option}" in message
