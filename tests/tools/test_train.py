"""kiras-train from end to end, with as little training as possible."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys

import matplotlib.image
import onnx
import pytest
import torch
from patience import patience

from kiras_rl.checkpoint import find_checkpoint, load_checkpoint, load_policy, save_checkpoint
from kiras_rl.config import load_config
from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.tools.train import claim, main
from kiras_rl.tools.training.curves import read_scalars
from kiras_rl.tools.training.progress import Progress


def only_run(runs, cfg):
    """Return the one run of a configuration."""
    (run,) = (runs / cfg).iterdir()
    return run


def contents(folder):
    """Return every file of a folder with its bytes, but the lock of who writes there."""
    files = (p for p in sorted(folder.rglob("*")) if p.is_file() and p.name != ".lock")
    return {p: p.read_bytes() for p in files}


@pytest.fixture(scope="module")
def smoke(smoke_run, tmp_path_factory):
    """A finished run of cfg/smoke.yaml of one's own."""
    return shutil.copytree(smoke_run, tmp_path_factory.mktemp("runs") / "smoke")


def test_a_run_holds_all_that_was_promised(smoke):
    assert load_config(str(smoke / "config.yaml")) == load_config("smoke")
    for name, iteration in (("flat.pt", 2), ("latest.pt", 4), ("best.pt", 4)):
        content = load_checkpoint(smoke / "checkpoints" / name)
        assert content["iteration"] == iteration
        assert content["phase"] == ("skill_learning" if iteration == 2 else "finetuning")
        assert content["description"]["provenance"]["steps"] == iteration * 24 * 8
    picture = matplotlib.image.imread(smoke / "curves.png")
    assert min(picture.shape[:2]) > 300
    scalars = read_scalars(smoke)
    assert scalars["Critic/task_reward"][0] == [1, 2, 3, 4]
    assert scalars["Critic/imitation_reward"][0] == [1, 2]
    assert scalars["Eval/score"][0] == [2, 4]
    assert scalars["Terrain/level_stairs_up"][0] == [3, 4]
    assert scalars["Eval_terrain/strict_stairs_up"][0] == [4]


def test_its_policy_file_is_the_checkpoint_s_policy(smoke):
    policy, description = load_policy(find_checkpoint(smoke))
    onboard = OnboardPolicy(smoke / "policy.onnx")
    assert list(onboard.metadata.skills) == description["skills"]
    onnx.checker.check_model(smoke / "policy.onnx")
    proprio, history = torch.randn(5, 34), torch.randn(5, 4 * 34)
    with torch.no_grad():
        actions, velocity = policy(proprio, history)
    given = onboard.infer(proprio.numpy(), history.numpy())
    for mine, its in zip((actions, velocity), given, strict=True):
        torch.testing.assert_close(mine, torch.from_numpy(its), atol=1e-5, rtol=0)


def test_it_says_what_to_do_next(smoke, capsys):
    assert main(["--resume", str(smoke), "finetuning.iterations=3"]) == 0
    out = capsys.readouterr().out
    assert "resuming at iteration 4" in out
    assert "5/5" in out
    assert f"kiras-play {smoke}" in out
    assert load_checkpoint(smoke / "checkpoints" / "latest.pt")["iteration"] == 5
    assert read_scalars(smoke)["Critic/task_reward"][0] == [1, 2, 3, 4, 5]


def test_two_runs_begun_at_once_get_two_folders(tmp_path):
    first, second, third = (claim(tmp_path / "solo8" / "12-00-00") for _ in range(3))
    assert len({first, second, third}) == 3
    assert all(folder.is_dir() for folder in (first, second, third))


def test_a_folder_for_runs_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "runs").symlink_to(tmp_path / "not_mounted")
    with pytest.raises(FileExistsError):
        claim(tmp_path / "runs" / "12-00-00")


def test_a_finetuning_that_broke_before_its_first_checkpoint_goes_on(tmp_path, monkeypatch):
    keep = ["--cfg", "smoke", "--runs", str(tmp_path), "checkpoint_minutes=999"]

    def broken(self, status):
        if status.iteration == 3 and status.phase == "finetuning":
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Progress, "show", broken)
        assert main([*keep, "finetuning.iterations=3", "evaluation.interval=1"]) == 130
    checkpoints = only_run(tmp_path, "smoke") / "checkpoints"
    assert load_checkpoint(checkpoints / "best.pt")["phase"] == "finetuning"
    flat = (checkpoints / "flat.pt").read_bytes()
    assert main(["--resume", str(checkpoints.parent)]) == 0
    assert (checkpoints / "flat.pt").read_bytes() == flat
    assert load_checkpoint(checkpoints / "latest.pt")["iteration"] == 5


def test_skill_learning_cannot_be_lengthened_when_it_is_over(smoke, capsys):
    message = refusal(capsys, "--resume", str(smoke), "iterations=5")
    assert "iterations=5: the skill learning of this run is over, after 2" in message


def test_a_checkpoint_outside_of_a_run_is_not_resumed(smoke, tmp_path, capsys):
    stray = tmp_path / "latest.pt"
    stray.write_bytes((smoke / "checkpoints" / "latest.pt").read_bytes())
    assert "lies in no run: give the run folder" in refusal(capsys, "--resume", str(stray))
    assert list(tmp_path.iterdir()) == [stray]


def test_a_file_of_one_s_own_without_imitation_and_evaluation_ends_as_well(tmp_path):
    mine = tmp_path / "mine.yaml"
    mine.write_text(
        "extends: ablations/no_sil\nnum_envs: 4\niterations: 1\n"
        "evaluation: {interval: 0, terrain: {level: 0}}\n"
        "finetuning: {iterations: 1, env: {terrain: {levels: 2, variants: 2}}}\n"
    )
    assert main(["--cfg", str(mine), "--runs", str(tmp_path / "runs")]) == 0
    run = only_run(tmp_path / "runs", "mine")
    assert (run / "policy.onnx").exists() and (run / "curves.png").exists()
    assert [p.name for p in (run / "checkpoints").iterdir()] == ["latest.pt"]


# --- what cannot be ------------------------------------------------------------------------------


def refusal(capsys, *argv):
    """Return the one line with which a command ends."""
    assert main([*argv]) == 2
    out, err = capsys.readouterr()
    assert err.startswith("error: ") and err.count("\n") == 1
    assert out == ""
    return err


@pytest.mark.parametrize(
    ("argv", "part"),
    [
        (["--cfg", "solo9"], "no configuration 'solo9': did you mean 'solo8'?"),
        (["--cfg", "smoke", "num_evs=3"], "unknown key 'num_evs'; did you mean 'num_envs'?"),
        (["--cfg", "smoke", "num_envs=x"], "could not be converted to Integer"),
        (["--cfg", "smoke", "robot=solo9"], "solo8"),
        (["--cfg", "smoke", "device=tpu"], "device=tpu: allowed are auto, cpu, cuda"),
        (["--cfg", "smoke", "sim.backend=x"], "allowed are auto, native, warp"),
        (["--cfg", "smoke", "env.rewards.terms.torques=-1"], "give a weight"),
        (["--cfg", "smoke", "env.rewards.terms.tork={weight: 1}"], "no term 'tork'"),
        (["--cfg", "smoke", "learner.estimator.adaboot=x"], "allowed are gate_update"),
        (["--cfg", "smoke", "learner.imitation.premium.rule=x"], "allowed are topk, record"),
        (["--cfg", "smoke", "evaluation.duration=1"], "more than the first 1.0 s"),
        (["--cfg", "smoke", "env.observations.proprio.foot_height={}"], "unknown observation term"),
        (["--cfg", "smoke", "env.action_clip=0"], "env.action_clip=0.0: must be positive"),
        (["--cfg", "smoke", "evaluation.terrain.level=2"], "terrain.level=2: allowed are 0 to 1"),
        (["--cfg", "smoke", "finetuning.env.terrain.types.hills={}"], "no term 'hills'"),
        (["--cfg", "smoke", "finetuning.learner.ppo.gama=1"], "did you mean 'learner.ppo.gamma'?"),
        (["--cfg", "smoke", "finetuning.env.rewards.terms.tork={weight: 1}"], "no term 'tork'"),
        (
            ["--cfg", "smoke", "finetuning.env.action_clip=0"],
            "finetuning: env.action_clip=0",
        ),
        (["--cfg", "smoke", "finetuning.sim.backend=x"], "allowed are auto, native, warp"),
        (["--cfg", "smoke", "finetuning.learner.ppo.actor_dims=[8]"], "other sizes of the actor"),
        (["--cfg", "smoke", "finetuning.learner.estimator=null"], "than in skill learning"),
        (["--cfg", "smoke", "env.randomization.payload=[-9,0]"], "the base weighs"),
        (["--cfg", "smoke", "learner.skill_init.floor=0.3"], "with 5 skills at most 0.2"),
        (["--cfg", "smoke", "device=cpu:x"], "allowed are auto, cpu, cuda, cuda:N"),
        (["--resume", "runs/nothing"], "does not exist: give a run folder or a checkpoint file"),
    ],
)
def test_a_mistake_gets_one_line(argv, part, tmp_path, capsys):
    assert part in refusal(capsys, *argv, "--runs", str(tmp_path))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_refused(capsys):
    assert "finds no CUDA device here; set device=cpu" in refusal(
        capsys, "--cfg", "smoke", "device=cuda"
    )


def test_a_run_that_cannot_go_on_is_left_as_it_was(smoke, capsys, tmp_path):
    before = contents(smoke)
    message = refusal(capsys, "--resume", str(smoke), "num_envs=5")
    assert "'num_envs' cannot change when a run is resumed; allowed: iterations" in message
    assert contents(smoke) == before
    foreign = tmp_path / "run" / "checkpoints" / "latest.pt"
    content = load_checkpoint(smoke / "checkpoints" / "latest.pt")
    save_checkpoint(foreign, content | {"skills": ["jump"]})
    before = contents(tmp_path)
    assert "was trained on the skills jump" in refusal(capsys, "--resume", str(tmp_path / "run"))
    foreign.write_bytes(b"no checkpoint")
    assert "is not a whole KiRAS checkpoint" in refusal(capsys, "--resume", str(foreign))
    assert contents(tmp_path).keys() == before.keys()


def test_the_command_line_is_checked_first(capsys):
    with pytest.raises(SystemExit) as caught:
        main([])
    assert caught.value.code == 2
    assert "one of the arguments --cfg --resume --sweep is required" in capsys.readouterr().err


# --- a process of its own ------------------------------------------------------------------------


def test_a_terminated_training_saves_and_goes_on(tmp_path, capsys):
    command = [sys.executable, "-m", "kiras_rl.tools.train", "--cfg", "smoke", "--runs", "."]
    overrides = ["iterations=100000", "evaluation.interval=0", "checkpoint_minutes=999"]
    overrides.append("finetuning=null")
    process = subprocess.Popen(
        command + overrides, cwd=tmp_path, text=True, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, env=os.environ | {"OMP_WAIT_POLICY": "passive"},
    )  # fmt: skip
    try:
        seen = ""
        for line in process.stdout:
            seen += line
            if "/100000 |" in line:  # the first iteration is done
                break
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=patience())
    finally:
        process.kill()
    assert (process.returncode, err) == (0, "")
    assert "stopped and saved; go on with: kiras-train --resume smoke" in out
    run = only_run(tmp_path, "smoke")
    done = load_checkpoint(run / "checkpoints" / "latest.pt")["iteration"]
    assert done >= 1
    assert main(["--resume", str(run), f"iterations={done + 1}"]) == 0
    assert (run / "policy.onnx").exists()
