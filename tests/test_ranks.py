"""Several ranks train one run: like one process with all their worlds, and to the bit again."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from patience import patience

from kiras_rl.checkpoint import load_checkpoint, save_checkpoint
from kiras_rl.phases import FINETUNING, SKILL_LEARNING
from kiras_rl.tools.training.curves import read_scalars
from kiras_rl.tools.training.run import resume

pytestmark = pytest.mark.slow  # a process a rank, and many trainings


@contextmanager
def torchrun(*arguments: str, cwd: Path) -> Iterator[subprocess.Popen]:
    """Start two ranks on a port of their own, and leave none behind."""
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2"]
    command += ["--rdzv-backend", "c10d", "--rdzv-endpoint", "localhost:0"]
    process = subprocess.Popen(
        [*command, *arguments], cwd=cwd, text=True, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, env=os.environ | {"OMP_WAIT_POLICY": "passive"},
    )  # fmt: skip
    try:
        yield process
    finally:
        process.terminate()  # not killed: it ends the ranks first
        process.communicate(timeout=patience())


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Do what tests/ranks.py does, on two ranks; return the folder of the results."""
    out = tmp_path_factory.mktemp("ranks")
    with torchrun(str(Path(__file__).with_name("ranks.py")), str(out), cwd=out) as process:
        printed, _ = process.communicate(timeout=patience())
    assert process.returncode == 0, printed
    (out / "printed.txt").write_text(printed)
    return out


@pytest.fixture(scope="module")
def ranks(folder):
    """Return the results of both ranks."""
    return [torch.load(folder / f"results_{rank}.pt", weights_only=True) for rank in (0, 1)]


@pytest.fixture(scope="module")
def run(folder):
    """Return the folder of the run of cfg/smoke.yaml on two ranks."""
    (run,) = (folder / "rank_0" / "runs" / "smoke").iterdir()
    return run


def same(a, b) -> bool:
    """Tell whether two nested states are equal to the bit."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, torch.Tensor):
        return torch.equal(torch.nan_to_num(a), torch.nan_to_num(b))
    return a == b


# --- as one process with all worlds --------------------------------------------------------------


@pytest.mark.parametrize(
    ("phase", "networks"),
    [
        (SKILL_LEARNING, {"actor", "critics", "estimator", "discriminator"}),
        (FINETUNING, {"actor", "critics", "estimator"}),
    ],
)
def test_two_ranks_have_the_gradients_of_one_process_with_the_worlds_of_both(
    ranks, phase, networks
):
    for rank in ranks:
        expected, given = rank["gradients"][phase]
        assert given.keys() == networks
        for name in networks:
            assert expected[name].abs().max() > 0.1, name
            torch.testing.assert_close(given[name], expected[name], atol=1e-5, rtol=0, msg=name)


def test_networks_buffer_and_probabilities_are_the_same_on_both_ranks(ranks):
    one, other = (rank["whole"]["learner"] for rank in ranks)
    for name in ("actor_state_dict", "critic_state_dict", "optimizer_state_dict", "learning_rate"):
        assert same(one[name], other[name]), name
    one, other = one["parts"], other["parts"]
    for part in ("estimator", "imitation"):
        for name in set(one[part]) - {"adaboot", "selector"}:
            assert same(one[part][name], other[part][name]), name
    for name in ("scores", "born", "trajectories"):
        first, second = (x["imitation"]["selector"][name] for x in (one, other))
        assert same(first, second), name
    drawn, also = (x["skill_init"]["probabilities"] for x in (one, other))
    assert same(drawn, also)
    assert len(drawn.unique()) > 1
    for name in ("probability", "ready"):
        assert same(one["estimator"]["adaboot"][name], other["estimator"]["adaboot"][name])
    assert one["estimator"]["adaboot"]["ready"]


def test_the_buffer_holds_windows_of_both_ranks(ranks):
    """What a rank recorded last is still in its recorder."""
    for rank in ranks:
        selector = rank["whole"]["learner"]["parts"]["imitation"]["selector"]
        kept = selector["trajectories"][selector["scores"].isfinite()][:, -1]  # last frames
        recorded = selector["_frames"].flatten(0, 1)
        assert (kept[:, None] == recorded).all(dim=-1).any()


def test_ranks_live_in_worlds_of_their_own(ranks):
    one, other = (rank["whole"] for rank in ranks)
    for name in ("env", "generators"):
        assert not same(one[name], other[name])


# --- one run -------------------------------------------------------------------------------------


def test_rank_0_alone_writes_and_prints(folder, ranks, run):
    assert ranks[1]["files"] == []
    assert (run / "policy.onnx").exists() and (run / "curves.png").exists()
    printed = (folder / "printed.txt").read_text()
    assert printed.count("2 x 8 worlds, native physics") == 1
    assert printed.count("4/4 |") == 1
    assert printed.count("next:       kiras-play") == 1


def test_a_mistake_that_all_ranks_make_is_said_once(folder):
    printed = (folder / "printed.txt").read_text()
    assert printed.count("error: --sweep trains on one process: start it without torchrun\n") == 1


def test_steps_and_scalars_are_those_of_both_ranks(run):
    content = load_checkpoint(run / "checkpoints" / "latest.pt")
    assert content["description"]["provenance"]["steps"] == 4 * 24 * 2 * 8
    scalars = read_scalars(run)
    assert scalars["Critic/task_reward"][0] == [1, 2, 3, 4]
    assert scalars["Eval/score"][0] == [2, 4]


def test_each_rank_has_its_share_of_the_cores(ranks):
    share = max(1, len(os.sched_getaffinity(0)) // 2)
    assert [rank["threads"] for rank in ranks] == [share, share]


def test_a_signal_to_one_rank_stops_both_after_the_same_iteration(folder, ranks):
    assert [rank["stopped"] for rank in ranks] == [2, 2]
    saved = load_checkpoint(folder / "rank_0" / "stopped" / "checkpoints" / "latest.pt")
    assert saved["iteration"] == 2


def test_a_value_that_is_not_finite_ends_both_ranks_with_a_reason(ranks):
    first, second = (rank["broken"] for rank in ranks)
    assert first.startswith("iteration 1: Another rank met values that are not finite.")
    assert second.startswith("iteration 1: The")
    assert "NaN" in second


# --- resuming ------------------------------------------------------------------------------------


def test_a_run_resumed_on_as_many_ranks_ends_with_the_same_bits(ranks):
    for rank in ranks:
        assert same(rank["whole"], rank["parts"])


def test_on_one_process_all_but_the_worlds_goes_on(run, caplog):
    saved = load_checkpoint(run / "checkpoints" / "latest.pt")
    with caplog.at_level(logging.WARNING, "kiras_rl"):
        runner = resume(run / "checkpoints" / "latest.pt", [])
    (message,) = caplog.messages
    assert "is of a run with 2 rank(s), this one has 1:" in message
    assert message.endswith("all worlds begin anew")
    assert runner.current_learning_iteration == 4
    assert runner.steps == 4 * 24 * 2 * 8
    mine = runner.alg.save()
    for name in ("actor_state_dict", "optimizer_state_dict", "learning_rate"):
        assert same(mine[name], saved["learner"][name])
    adaboot, before = (x["parts"]["estimator"]["adaboot"] for x in (mine, saved["learner"]))
    assert same(adaboot["probability"], before["probability"])
    assert adaboot["_last"].isnan().all() and (adaboot["_length"] == 0).all()
    assert not same(runner.env.state_dict()["sim"], saved["env"]["sim"])
    drawn = saved["learner"]["parts"]["skill_init"]["probabilities"]
    assert same(runner.env.state_dict()["probabilities"], drawn)


def test_the_premium_buffer_goes_on_too_but_not_what_is_being_recorded(folder, caplog, tmp_path):
    content = load_checkpoint(folder / "rank_0" / "whole" / "checkpoints" / "latest.pt")
    latest = tmp_path / "checkpoints" / "latest.pt"
    save_checkpoint(latest, content)
    selector = resume(latest, []).alg.parts["imitation"].selector.state_dict()
    before = content["learner"]["parts"]["imitation"]["selector"]
    assert same(selector["trajectories"], before["trajectories"])
    assert same(selector["scores"], before["scores"])
    assert (selector["_age"] == 0).all() and (before["_age"] > 0).any()


def test_a_checkpoint_from_before_there_were_ranks_goes_on_exactly(run, tmp_path, caplog):
    content = load_checkpoint(run / "checkpoints" / "latest.pt")
    del content["others"]
    latest = tmp_path / "checkpoints" / "latest.pt"
    save_checkpoint(latest, content)
    runner = resume(latest, [])
    assert caplog.messages == []
    assert same(runner.env.state_dict(), content["env"])


# --- what can go wrong ---------------------------------------------------------------------------


def pid_of(rank: int, parent: int) -> int:
    """Return the process of a rank among the children of torchrun."""
    children = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    for pid in map(int, children):
        if f"\0RANK={rank}\0" in Path(f"/proc/{pid}/environ").read_text():
            return pid
    raise LookupError(f"no rank {rank} below {parent}")


def test_a_rank_that_dies_ends_the_run_and_leaves_the_checkpoint(tmp_path):
    endless = ["iterations=100000", "finetuning=null", "evaluation.interval=0"]
    endless += ["checkpoint_minutes=0"]
    command = ["-m", "kiras_rl.tools.train", "--cfg", "smoke", "--runs", "."]
    with torchrun(*command, *endless, cwd=tmp_path) as process:
        end = time.monotonic() + patience()
        while not list(tmp_path.glob("smoke/*/checkpoints/latest.pt")):
            assert process.poll() is None and time.monotonic() < end
            time.sleep(0.1)
        os.kill(pid_of(1, process.pid), signal.SIGKILL)
        printed, _ = process.communicate(timeout=patience())
    assert process.returncode != 0
    assert printed.count("error: ") == 1
    assert "error: rank 0 of 2: another rank died or did not answer" in printed
    assert "the last checkpoint stays as it is: go on with --resume" in printed
    (latest,) = tmp_path.glob("smoke/*/checkpoints/latest.pt")
    content = load_checkpoint(latest)
    assert content["iteration"] >= 1
    assert len(content["others"]) == 1
    assert list(latest.parent.iterdir()) == [latest]
