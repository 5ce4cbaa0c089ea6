"""The runner: a stopped training goes on bit for bit, and nothing else loads into it."""

from __future__ import annotations

import itertools
import math
import signal
import threading
from dataclasses import replace
from types import SimpleNamespace

import pytest
from states import differences
from tensorboard.summary.writer import event_file_writer

from kiras_rl.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from kiras_rl.config import list_configs, load_config
from kiras_rl.envs import make_env
from kiras_rl.phases import FINETUNING, SKILL_LEARNING, phase_of, plan
from kiras_rl.process import StopRequest
from kiras_rl.runner import Evaluators, KirasRunner
from kiras_rl.soundness import TrainingError
from kiras_rl.tools.training.curves import read_scalars

# Noise, randomization and delay are on; episodes and premium windows end many times.
TINY = (
    "num_envs=16",
    "iterations=6",
    "sim.backend=native",
    "env.terminations.episode_length=0.5",
    "evaluation.interval=0",
    "learner.estimator.adaboot=both",
    "learner.imitation.premium.window=24",
    "learner.imitation.premium.min_command=0",
    "learner.imitation.premium.min_progress=0",
    "learner.imitation.premium.max_distance=100",
    "learner.imitation.discriminator.batch_size=128",
)

ROUGH = (
    "iterations=2",
    "finetuning.iterations=3",
    "finetuning.env.terrain.levels=2",
    "finetuning.env.terrain.variants=2",
)


POSTURE = (0.2, 0.0, 0.3)  # height, pitch, velocity
GAIT = (2.0, 3.0, 1.0, 0.6, 0.0, 0.0, 5.0, 1.0, 0.0)  # from lifts on, all good


@pytest.fixture
def make_runner(tmp_path):
    """Return a function that builds a run from its configuration: what a new process does."""

    def make(run, *overrides, evaluate=None, phase=SKILL_LEARNING):
        config = load_config("solo8", [*TINY, *overrides])
        resolved = phase_of(config, phase)
        evaluators = Evaluators(flat=evaluate)
        return KirasRunner(make_env(resolved.config), resolved, tmp_path / run, "cpu", evaluators)

    return make


@pytest.fixture
def tell():
    """Return a function that sums up a run's evaluations as a constant result."""
    from kiras_rl.evaluation.flat import SkillResult

    return lambda error: {"walk": SkillResult(*POSTURE, error, 0.0, 0.0, *GAIT)}


def latest(runner):
    return runner.run_dir / "checkpoints" / "latest.pt"


def test_the_log_holds_both_phases_whatever_its_files_are_called(make_runner, monkeypatch):
    """Names are of the second and a counter, and readers sort them as text: 10 before 9."""
    monkeypatch.setattr(event_file_writer, "time", SimpleNamespace(time=lambda: 1.8e9))
    counter = SimpleNamespace(get=itertools.count(9).__next__)
    monkeypatch.setattr(event_file_writer, "_global_uid", counter)
    flat = make_runner("run", *ROUGH)
    assert flat.learn()
    rough = make_runner("run", *ROUGH, phase=FINETUNING)
    rough.begin_from(latest(flat))
    rough.learn(2)
    log = read_scalars(rough.run_dir)
    assert log["Critic/task_reward"][0] == [1, 2, 3, 4]
    assert log["Residual/distance"][0] == [3, 4]


def test_a_resumed_training_ends_with_the_same_bits(make_runner):
    whole = make_runner("whole")
    assert whole.learn()
    first = make_runner("parts")
    assert not first.learn(3)
    second = make_runner("parts", "seed=77")  # what it draws before loading must not matter
    second.load(str(latest(first)))
    assert second.current_learning_iteration == 3
    assert second.learn()
    one, other = load_checkpoint(latest(whole)), load_checkpoint(latest(second))
    assert one["iteration"] == other["iteration"] == 6
    for part in ("learner", "env", "generators", "policy"):
        assert differences(one[part], other[part], part) == []
    assert one["learner"]["parts"]["imitation"]["selector"]["scores"].isfinite().any()
    assert one["learner"]["parts"]["estimator"]["adaboot"]["ready"]


def test_a_training_resumed_anywhere_in_both_phases_ends_with_the_same_bits(make_runner):
    def begin(run):
        runner = make_runner(run, *ROUGH, phase=FINETUNING)
        runner.begin_from(latest(runner))
        return runner

    whole = make_runner("whole", *ROUGH)
    assert whole.learn()
    whole = begin("whole")
    assert whole.learn()

    first = make_runner("parts", *ROUGH)
    first.learn(1)
    again = make_runner("parts", *ROUGH, "seed=77")
    again.load(str(latest(first)))
    assert again.learn()
    second = begin("parts")
    second.learn(1)
    last = make_runner("parts", *ROUGH, "seed=77", phase=FINETUNING)
    last.load(str(latest(second)))
    assert last.current_learning_iteration == 3
    assert last.learn()

    one, other = load_checkpoint(latest(whole)), load_checkpoint(latest(last))
    assert one["phase"] == other["phase"] == FINETUNING
    assert one["iteration"] == other["iteration"] == 5
    for part in ("learner", "env", "generators", "policy"):
        assert differences(one[part], other[part], part) == []
    assert len(one["env"]["tile"].unique()) > 2


def test_a_checkpoint_of_another_phase_is_refused(make_runner):
    runner = make_runner("run", *ROUGH)
    runner.save_latest()
    with pytest.raises(CheckpointError, match="is of the phase skill_learning, not of finetuning"):
        make_runner("other", *ROUGH, phase=FINETUNING).load(str(latest(runner)))


@pytest.mark.parametrize("cfg", [name for name in list_configs() if name.startswith("ablations/")])
def test_every_ablation_trains_without_the_part_it_leaves_out(cfg):
    config, seen = load_config(cfg, ["num_envs=4", "iterations=2", "evaluation.interval=0"]), []
    runner = KirasRunner(make_env(config), plan(config)[0], None, "cpu")
    runner.learn(on_iteration=lambda status: seen.append(status.scalars))
    for scalars in seen:
        assert all(math.isfinite(value) for value in scalars.values())
    logged = set(seen[-1])
    without = cfg.removeprefix("ablations/")
    assert ("Discriminator/loss" in logged) == (without != "no_sil")
    assert ("Critic/imitation_value" in logged) == (without not in ("no_sil", "no_muc"))
    assert ("Estimator/velocity" in logged) == (without != "no_ece")
    assert ("Skill/probability_walk" in logged) == (without != "no_skill_init")


def test_another_seed_is_another_training(make_runner):
    one, other = make_runner("one"), make_runner("other", "seed=2")
    for runner in (one, other):
        runner.learn(1)
    assert differences(one.alg.actor.state_dict(), other.alg.actor.state_dict())


def test_a_checkpoint_of_other_skills_is_refused(make_runner):
    runner = make_runner("run")
    runner.save_latest()
    foreign = load_checkpoint(latest(runner)) | {"skills": ["walk", "jump"]}
    save_checkpoint(latest(runner), foreign)
    with pytest.raises(CheckpointError) as caught:
        runner.load(str(latest(runner)))
    message = str(caught.value)
    assert "was trained on the skills walk, jump; the robot has walk, crawl" in message
    assert "\n" not in message


def test_the_policy_with_the_best_last_evaluations_is_kept(make_runner, tell):
    errors = iter([0.03, 0.03, 0.00, 0.03, 0.01, 0.01, 0.03])
    runner = make_runner(
        "run",
        *("iterations=7", "evaluation.interval=1", "learner.ppo.num_steps=2"),
        evaluate=lambda _: tell(next(errors)),
    )
    seen = []
    runner.learn(on_iteration=lambda status: seen.append(status.scalars["Eval/score"]))
    assert seen == pytest.approx([1.0, 1.0, 0.0, 1.0, 1 / 3, 1 / 3, 1.0])
    best = load_checkpoint(runner.run_dir / "checkpoints" / "best.pt")
    assert best["iteration"] == 5  # means of three: 2/3 at 3 and 4, 4/9 at 5, 5/9 at 6 and 7
    assert best["best_score"] == pytest.approx(4 / 9)


@pytest.mark.parametrize(("interval", "evaluated"), [(2, [2, 4, 5]), (10, [5]), (0, [])])
def test_evaluations_come_at_their_interval_and_at_the_end(make_runner, tell, interval, evaluated):
    runner = make_runner(
        "run", "iterations=5", f"evaluation.interval={interval}", "learner.ppo.num_steps=2",
        evaluate=lambda _: tell(0.0),
    )  # fmt: skip
    seen = []

    def note(status):
        if "Eval/score" in status.scalars:
            seen.append(status.iteration)

    runner.learn(on_iteration=note)
    assert seen == evaluated


def test_without_a_folder_nothing_is_written(tmp_path):
    config = load_config("solo8", [*TINY, "iterations=1"])
    KirasRunner(make_env(config), plan(config)[0], None, "cpu").learn()
    assert list(tmp_path.iterdir()) == []


def test_an_update_that_leaves_no_numbers_ends_the_run(make_runner):
    runner = make_runner("broken")
    runner.learn(1)
    before = latest(runner).read_bytes()
    weight = next(runner.alg.parts["estimator"].estimator.parameters())
    weight.data.view(-1)[0] = math.nan
    with pytest.raises(TrainingError, match=r"iteration 2: .*not finite"):
        runner.learn()
    assert latest(runner).read_bytes() == before


def test_a_run_goes_on_with_its_own_robot(make_runner):
    runner = make_runner("robot")
    runner.save_latest()
    other = make_runner("robot")
    robot = other.env.robot_cfg
    other.env.robot_cfg = replace(robot, kp=2 * robot.kp)
    with pytest.raises(CheckpointError) as caught:
        other.load(str(latest(runner)))
    message = str(caught.value)
    assert f"kp (number 0) was {robot.kp[0]} and is {2 * robot.kp[0]}" in message
    assert "--changed-robot" in message and "\n" not in message
    other.takes_changed_robot = True
    other.load(str(latest(runner)))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_becomes_a_wish_to_stop_once(number):
    before = signal.getsignal(number)
    with StopRequest() as stop:
        assert not stop.requested
        signal.raise_signal(number)
        assert stop.requested
        assert signal.getsignal(number) == before  # a second signal acts at once
    assert signal.getsignal(number) == before


def test_a_training_beside_the_main_thread_takes_no_signals():
    flags = []

    def work():
        with StopRequest() as stop:
            flags.append(stop.requested)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert flags == [False]
