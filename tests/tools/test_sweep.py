"""kiras-train --sweep from end to end, with as little training as possible."""

from __future__ import annotations

import itertools
import os
import shlex
import signal
import subprocess
import sys

import pytest
import torch
from patience import patience

from kiras_rl.checkpoint import load_checkpoint
from kiras_rl.config import list_configs, load_config
from kiras_rl.tools.driving.side_by_side import core_shares
from kiras_rl.tools.train import main
from kiras_rl.tools.training.progress import Progress
from kiras_rl.tools.training.run import begin
from kiras_rl.tools.training.sweep import list_sweeps, load_sweep

TINY = ["num_envs=4", "iterations=2", "finetuning=null", "evaluation.interval=0"]
NO_SIL = "{cfg: smoke, overrides: [learner.imitation=null]}"


def write(path, configs, seeds="[1, 2]", overrides=TINY):
    """Write a sweep called `tiny`."""
    path.write_text(
        f"name: tiny\nconfigs: {configs}\nseeds: {seeds}\noverrides: [{', '.join(overrides)}]\n"
    )
    return str(path)


def latest(folder):
    return load_checkpoint(folder / "checkpoints" / "latest.pt")


def contents(folder):
    """Return every file of a folder with its bytes."""
    return {p: p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def rows(out):
    """Return configuration, seed, iterations and status of each row of the last table."""
    table = out[out.rindex("┡") :]
    cells = [line.strip("│").split("│") for line in table.splitlines() if line.startswith("│")]
    return [tuple(row[i].strip() for i in (0, 1, 2, 5)) for row in cells]


@pytest.fixture
def interrupt(monkeypatch):
    """Return a function: after so many iterations from now on, Ctrl-C."""
    show = Progress.show

    def after(iterations):
        numbers = itertools.count(1)

        def show_and_stop(self, status):
            show(self, status)
            if next(numbers) == iterations:
                signal.raise_signal(signal.SIGINT)

        monkeypatch.setattr(Progress, "show", show_and_stop)

    return after


@pytest.fixture(autouse=True)
def one_thread():
    """A few worlds are faster on one thread, much faster on a busy machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def trained_alone(*overrides):
    """Return the learner of an ordinary run that never stopped."""
    runner = begin(load_config("smoke", [*TINY, *overrides]))
    assert runner.learn()
    return runner


def assert_same_bits(content, runner):
    """Compare a checkpoint with a learner: weights, worlds and random numbers."""
    saved, learner = content["learner"], runner.alg.save()
    for one, other in (
        (content["policy"], dict(runner.alg.policy().state_dict())),
        (saved["actor_state_dict"], learner["actor_state_dict"]),
        (saved["critic_state_dict"], learner["critic_state_dict"]),
        (content["env"]["sim"]["state"], runner.env.state_dict()["sim"]["state"]),
        (content["env"]["generator"], runner.env.state_dict()["generator"]),
    ):
        torch.testing.assert_close(one, other, rtol=0, atol=0, equal_nan=True)


def test_a_sweep_stops_goes_on_and_grows(tmp_path, capsys, interrupt):
    runs, configs = tmp_path / "runs", f"{{kiras: smoke, no_sil: {NO_SIL}}}"
    sweep = runs / "sweeps" / "tiny"
    command = ["--sweep", write(tmp_path / "a.yaml", configs, "[1]"), "--runs", str(runs)]

    interrupt(3)  # after the first iteration of the second run
    assert main(command) == 0
    out = capsys.readouterr().out
    assert rows(out) == [("kiras", "1", "2", "finished"), ("no_sil", "1", "1", "interrupted")]
    last = out.splitlines()[-1]
    assert last == f"stopped and saved; go on with: kiras-train {shlex.join(command)}"
    before = contents(sweep / "kiras")

    # one more configuration, which breaks; a key of the machine may change
    overrides = "[learner.estimator.relative_step=1e9, learner.estimator.adaboot=off]"
    broken = f"{{cfg: smoke, overrides: {overrides}}}"
    write(tmp_path / "a.yaml", f"{{broken: {broken}, {configs[1:-1]}}}", "[1]")
    interrupt(0)  # never
    assert main([*shlex.split(last.partition("kiras-train ")[2]), "sim.threads=1"]) == 1
    out, err = capsys.readouterr()
    assert err.startswith("error: broken/seed_1: iteration 1: ") and err.count("\n") == 1
    assert f"finished before: {sweep}/kiras/seed_1" in out
    assert "resuming at iteration 1" in out
    assert "go on with" not in out
    assert rows(out) == [
        ("broken", "1", "-", "failed"),
        ("kiras", "1", "2", "finished"),
        ("no_sil", "1", "2", "finished"),
    ]
    assert contents(sweep / "kiras") == before
    assert_same_bits(latest(sweep / "no_sil/seed_1"), trained_alone("learner.imitation=null"))

    before = contents(sweep)
    message = refusal(capsys, *command, "iterations=3")
    assert f"{sweep}/kiras/seed_1 was begun with iterations=2, the sweep has 3" in message
    assert contents(sweep) == before


@pytest.mark.slow
def test_a_sweep_compares_all_configurations_of_a_seed_first(tmp_path, capsys, interrupt):
    runs, configs = tmp_path / "runs", f"{{kiras: smoke, no_sil: {NO_SIL}}}"
    sweep = runs / "sweeps" / "tiny"
    command = ["--sweep", write(tmp_path / "a.yaml", configs), "--runs", str(runs)]

    interrupt(4)  # during the last iteration of the second run, which is then concluded
    assert main(command) == 0
    assert rows(capsys.readouterr().out) == [
        ("kiras", "1", "2", "finished"),
        ("no_sil", "1", "2", "finished"),
        ("kiras", "2", "-", "not begun"),
        ("no_sil", "2", "-", "not begun"),
    ]
    interrupt(1)
    assert main(command) == 0
    assert [row[3] for row in rows(capsys.readouterr().out)][2:] == ["interrupted", "not begun"]
    interrupt(0)
    assert main(command) == 0
    assert [row[3] for row in rows(capsys.readouterr().out)] == 4 * ["finished"]
    for seed in (1, 2):
        assert_same_bits(latest(sweep / f"kiras/seed_{seed}"), trained_alone(f"seed={seed}"))
    message = refusal(capsys, *command, "learner.skill_init=null")
    assert "was begun with learner.skill_init={...}, the sweep has null" in message


# --- several at a time ---------------------------------------------------------------------------


def test_jobs_train_what_each_run_would_have_trained_alone(tmp_path, capsys):
    runs, jobs = tmp_path / "runs", min(2, len(os.sched_getaffinity(0)))
    overrides = "[learner.estimator.relative_step=1e9, learner.estimator.adaboot=off]"
    configs = f"{{kiras: smoke, broken: {{cfg: smoke, overrides: {overrides}}}}}"
    command = ["--sweep", write(tmp_path / "a.yaml", configs, "[1]"), "--runs", str(runs)]
    before = os.sched_getaffinity(0)

    assert main([*command, "--jobs", str(jobs)]) == 1
    out = capsys.readouterr().out
    assert rows(out) == [("kiras", "1", "2", "finished"), ("broken", "1", "-", "failed")]
    assert "kiras/seed_1 | 2/2 | " in out and "go on with" not in out
    assert_same_bits(latest(runs / "sweeps/tiny/kiras/seed_1"), trained_alone())
    assert os.sched_getaffinity(0) == before

    assert main([*command, "--only", "kiras/seed_1"]) == 0
    out = capsys.readouterr().out
    assert f"finished before: {runs}/sweeps/tiny/kiras/seed_1" in out
    assert "broken" not in out


def test_jobs_divide_the_cores_of_this_process(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {7, 2, 3, 4, 5})
    assert core_shares(1) == [{2, 3, 4, 5, 7}]
    assert core_shares(2) == [{2, 3}, {4, 5, 7}]
    assert core_shares(5) == [{2}, {3}, {4}, {5}, {7}]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGINT, signal.SIGTERM])
def test_stopped_jobs_save(number, tmp_path):
    jobs = str(min(2, len(os.sched_getaffinity(0))))
    overrides = ["num_envs=4", "iterations=100000", "finetuning=null", "evaluation.interval=0"]
    file = write(tmp_path / "a.yaml", "[smoke]", "[1, 2, 3]", [*overrides, "checkpoint_minutes=99"])
    command = ["--sweep", file, "--runs", str(tmp_path), "--jobs", jobs]
    process = subprocess.Popen(
        [sys.executable, "-m", "kiras_rl.tools.train", *command], cwd=tmp_path, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    try:
        started = set()
        for line in process.stdout:
            if "/100000 |" in line:  # an iteration is done
                started.add(line.split()[0])
            if len(started) == int(jobs):
                break
        process.send_signal(number)
        out, err = process.communicate(timeout=patience())
    finally:
        process.kill()
    assert (process.returncode, err) == (0, "")
    last = out.splitlines()[-1]
    assert last == f"stopped and saved; go on with: kiras-train {shlex.join(command)}"
    status = [row[3] for row in rows(out)]
    assert status == int(jobs) * ["interrupted"] + (3 - int(jobs)) * ["not begun"]
    for name in started:
        assert latest(tmp_path / "sweeps/tiny" / name)["iteration"] >= 1


# --- what cannot be ------------------------------------------------------------------------------


def refusal(capsys, *argv):
    """Return the one line with which a command ends."""
    assert main([*argv]) == 2
    out, err = capsys.readouterr()
    assert err.startswith("error: ") and err.count("\n") == 1
    assert out == ""
    return err


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("", "holds no keys"),
        ("[1, 2]", "holds no keys"),
        ("name: [", "is not readable YAML"),
        ("configs: [smoke]", "leaves out: name, seeds"),
        ("name: a/b\nconfigs: [smoke]\nseeds: [1]", "'a/b' names a folder: use letters"),
        ("name: a\nconfigs: []\nseeds: [1]", "configs: give names, [solo8, ablations/no_sil]"),
        ("name: a\nconfigs: {x: {cf: smoke}}\nseeds: [1]", "configs.x.cf: Key 'cf' not in"),
        ("name: a\nconfigs: {x: {}}\nseeds: [1]", "leaves out: configs.x.cfg"),
        ("name: a\nconfigs: [go1, x/go1]\nseeds: [1]", "two configurations would be called go1"),
        ("name: a\nconfigs: [smoke]\nseeds: [1, 1]", "seeds: [1, 1]: give at least one"),
        ("name: a\nconfigs: [smoke]\nseeds: [x]", "seeds[0]: Value 'x'"),
        ("name: a\nconfigs: [smoke]\nseeds: [1]\nseed: 1", "seed: Key 'seed' not in"),
        (
            "name: a\nconfigs: [smoke]\nseeds: [1]\noverrides: [seed=2]",
            "a sweep has a list of seeds: set `seeds` there",
        ),
        (
            "name: a\nconfigs: {ok: smoke, bad: {cfg: smoke, overrides: [num_evs=2]}}\nseeds: [1]",
            "bad: override 'num_evs=2': unknown key 'num_evs'; did you mean 'num_envs'?",
        ),
        (
            "name: a\nconfigs:\n  ok: smoke\n  bad:\n    cfg: smoke\n    overrides:\n"
            "    - env.rewards.terms.tork={weight: 1}\nseeds: [1]",
            "bad: overrides: put quotes around {",
        ),
        (
            "name: a\nconfigs:\n  ok: smoke\n  bad:\n    cfg: smoke\n    overrides:\n"
            "    - 'env.rewards.terms.tork={weight: 1}'\nseeds: [1]\noverrides: [finetuning=null]",
            "bad: env.rewards.terms: no term 'tork'|bad: no term",
        ),
        (
            "name: a\nconfigs:\n  bad:\n    cfg: smoke\n    overrides:\n"
            "    - evaluation.terrain.level=2\nseeds: [1]",
            "bad: evaluation.terrain.level=2: allowed are 0 to 1",
        ),
    ],
)
def test_a_mistake_gets_one_line_before_anything_is_trained(text, part, tmp_path, capsys):
    path = tmp_path / "a.yaml"
    path.write_text(text)
    message = refusal(capsys, "--sweep", str(path), "--runs", str(tmp_path / "runs"))
    assert any(option in message for option in part.split("|")), message
    assert list(tmp_path.iterdir()) == [path]


def test_an_unknown_sweep_is_refused(capsys):
    assert "no sweep 'ablation': shipped are ablations" in refusal(capsys, "--sweep", "ablation")


# --- what is shipped -----------------------------------------------------------------------------


def test_the_shipped_sweep_compares_the_ablations_at_one_budget(tmp_path):
    assert list_sweeps() == ["ablations", "both_phases", "efficiency"]
    runs = load_sweep("ablations", [], tmp_path)
    ablations = [name for name in list_configs() if name.startswith("ablations/")]
    labels = {"kiras", *(name.removeprefix("ablations/") for name in ablations)}
    assert len(labels) == 5
    assert {run.label for run in runs[:5]} == {run.label for run in runs[5:]} == labels
    assert [run.config.seed for run in runs] == 5 * [1] + 5 * [2]
    for run in runs:
        config = run.config
        assert config.num_envs * config.learner.ppo.num_steps * config.iterations == 9_830_400
        assert config.finetuning is None
        assert run.folder == tmp_path / "sweeps" / "ablations" / run.label / f"seed_{config.seed}"
        assert (config.learner.imitation is None) == (run.label == "no_sil")
        assert (config.learner.multi_critic is None) == (run.label == "no_muc")
        assert (config.learner.estimator is None) == (run.label == "no_ece")
        assert (config.learner.skill_init is None) == (run.label == "no_skill_init")


def test_both_phases_of_the_ablations_have_one_budget(tmp_path):
    runs = load_sweep("both_phases", [], tmp_path)
    assert [r.label for r in runs] == [r.label for r in load_sweep("ablations", [], tmp_path)[:5]]
    for config in (run.config for run in runs):
        steps = config.num_envs * config.learner.ppo.num_steps
        assert steps * config.iterations == 12_288_000
        assert steps * config.finetuning.iterations == 9_830_400


def test_the_sweep_of_efficiency_uses_the_same_steps_in_other_ways(tmp_path):
    runs = load_sweep("efficiency", [], tmp_path)
    assert len(runs) == 2 * 5
    for run in runs:
        config = run.config
        assert config.num_envs * config.learner.ppo.num_steps * config.iterations == 9_830_400
    learners = [run.config.learner for run in runs[:5]]
    assert all(learners.count(learner) == 1 for learner in learners)
