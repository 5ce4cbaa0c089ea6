"""Two minutes of real training on two cores: everything that should move moves the right way."""

from __future__ import annotations

import numpy as np
import pytest

from kiras_rl.checkpoint import find_checkpoint, load_policy
from kiras_rl.config import load_config
from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.envs import make_env
from kiras_rl.export import export_policy
from kiras_rl.phases import plan
from kiras_rl.runner import KirasRunner
from kiras_rl.tools.driving.driver import Driver
from kiras_rl.tools.driving.script import Segment, record
from kiras_rl.tools.evaluation.evaluator import make_evaluators

pytestmark = pytest.mark.slow

ITERATIONS = 45  # of a run planned for more: its schedules stay where skills are found


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The run, what it logged in each iteration, and its last evaluation."""
    schedule = ["iterations=260", f"evaluation.interval={ITERATIONS}"]
    overrides = [*schedule, "device=cpu", "num_envs=1024", "learner.estimator.adaboot=off"]
    phase = plan(load_config("solo8_quick", overrides))[0]
    run = tmp_path_factory.mktemp("run")
    evaluators = make_evaluators(phase, "cpu")
    runner = KirasRunner(make_env(phase.config), phase, run, "cpu", evaluators)
    log = []
    runner.learn(ITERATIONS, on_iteration=lambda status: log.append(status.scalars))
    return run, log, runner.evaluation


@pytest.fixture(scope="module")
def logged(trained):
    """Return a function: the mean of a logged number over some iterations."""
    return lambda tag, *span: np.mean([scalars[tag] for scalars in trained[1][slice(*span)]])


def test_the_task_is_learned(logged):
    assert logged("Critic/task_reward", -5, None) > logged("Critic/task_reward", 0, 5) + 0.1


def test_the_discriminator_tells_expert_from_policy(logged):
    assert logged("Discriminator/expert", -10, None) > 0.1
    assert logged("Discriminator/policy", -10, None) < -0.1


def test_the_policy_grows_more_like_the_experts(logged):
    # it falls at first, while the discriminator learns who is who
    assert logged("Critic/imitation_reward", -5, None) > logged("Critic/imitation_reward", 8, 15)


def test_the_estimator_learns_the_velocity(logged):
    assert logged("Estimator/velocity", -10, None) < 0.6 * logged("Estimator/velocity", 0, 3)


def test_the_critics_foresee_the_returns(trained, logged):
    for group in ("task", "imitation"):
        value, future = (logged(f"Critic/{group}_{x}", -5, None) for x in ("value", "return"))
        # returns may pass through zero: the error is compared with how far they have changed
        returns = [scalars[f"Critic/{group}_return"] for scalars in trained[1]]
        assert value == pytest.approx(future, abs=0.1 * (max(returns) - min(returns)))


def test_skills_part(trained):
    _, _, skills = trained
    assert skills["stilt"].height > skills["crawl"].height + 0.04
    assert skills["pitch_down"].pitch > skills["pitch_up"].pitch + 0.15


def test_the_policy_plays_outside_of_training(trained, tmp_path):
    run, _, skills = trained
    path = tmp_path / "policy.onnx"
    export_policy(*load_policy(find_checkpoint(run)), path)
    driver = Driver(OnboardPolicy(path))
    names = driver.metadata.skills
    trace = record(driver, [Segment(2.0, name, (0.0, 0.0, 0.0)) for name in names])
    assert not trace.fallen.any()
    second_half = trace.time % 2.0 > 1.0
    height = {
        name: trace.base_height[(trace.skill == i) & second_half].mean()
        for i, name in enumerate(names)
    }
    for name in ("walk", "stilt", "pitch_down"):
        assert height[name] == pytest.approx(skills[name].height, abs=0.03)
    assert height["stilt"] > height["walk"] + 0.02
