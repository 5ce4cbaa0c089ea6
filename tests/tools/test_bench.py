"""kiras-bench: every figure is there and is what it says; mistakes are one line."""

from __future__ import annotations

import json
import time

import pytest
import torch

from kiras_rl.tools import timing
from kiras_rl.tools.bench import main

SMALL = ("--worlds=16", "--rounds=1", "learner.ppo.num_steps=4", "learner.ppo.num_mini_batches=2")


@pytest.fixture(autouse=True)
def one_thread():
    """Leave one thread to torch: on a busy machine two of them mostly wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def bench(tmp_path, capsys):
    """Run the command on a small scale; return its figures and what it printed."""

    def run(*arguments):
        path = tmp_path / "out.json"
        assert main([*SMALL, f"--json={path}", *arguments]) == 0
        return json.loads(path.read_text()), capsys.readouterr().out

    return run


def test_the_environment_is_measured_against_the_batch_alone(bench):
    report, out = bench("--parts=physics")
    physics = report["physics"]
    assert physics["share_of_bare_speed"]["mujoco.batch"]["median"] == 1.0
    seconds = physics["seconds_per_step"]
    shares = physics["share_of_bare_speed"]
    for variant in ("batch without sensors", "NativeSimulation.step", "environment step"):
        ratio = seconds["mujoco.batch"]["median"] / seconds[variant]["median"]
        assert shares[variant]["median"] == pytest.approx(ratio)
        rate = physics["steps_per_second"][variant]
        assert rate == pytest.approx(16 / seconds[variant]["median"])
        assert variant in out
    assert "target: at least 0.8" in out


def test_the_parts_of_an_environment_step_are_named_and_timed(bench):
    parts = bench("--parts=physics")[0]["physics"]["parts_seconds"]
    for part in ("physics", "rewards, terminations, features", "resets", "observations"):
        assert parts[part] > 0.0


def test_terrain_is_measured_against_the_batch_on_it_and_against_flat_ground(bench):
    report, out = bench("--parts=terrain", "finetuning.env.terrain.levels=2")
    seconds = report["terrain"]["seconds_per_step"]
    flat, bare, rough = (
        seconds[name]["median"]
        for name in (
            "environment step", "mujoco.batch on terrain", "environment step on terrain"
        )
    )  # fmt: skip
    assert report["terrain"]["share_of_bare_speed"]["median"] == pytest.approx(bare / rough)
    assert report["terrain"]["times_flat"]["median"] == pytest.approx(rough / flat)
    assert "target: at least 0.75" in out
    assert "target: at most 2.5" in out


def test_every_part_of_the_learner_has_a_price(bench):
    report, out = bench("--parts=learning")
    learning = report["learning"]
    parts = ("imitation", "multi_critic", "estimator", "skill_init")
    assert tuple(learning["price_seconds"]) == parts
    times = learning["seconds_per_iteration"]
    assert len(times) == 2 + 1 + len(parts)
    assert learning["reference"] == min(list(times)[:2], key=lambda name: times[name]["median"])
    assert learning["times_reference"][learning["reference"]]["median"] == 1.0
    updates = learning["seconds_per_update"]
    assert all(0.0 < updates[name]["median"] < times[name]["median"] for name in times)
    assert "target: at most 1.3" in out


def test_a_part_that_the_configuration_lacks_has_no_price(bench):
    report, _ = bench("--parts=learning", "learner.imitation=null", "learner.estimator=null")
    assert list(report["learning"]["price_seconds"]) == ["multi_critic", "skill_init"]


def test_the_exported_policy_is_fast_enough_for_50_hz(bench):
    inference = bench("--parts=inference")[0]["inference"]
    assert 0.0 < inference["median_seconds"] < 0.02
    assert inference["median_seconds"] <= inference["p99_seconds"]


def test_the_report_says_where_and_with_what_it_was_measured(bench):
    report, out = bench("--parts=inference", "seed=3")
    assert report["machine"]["cores"] >= 1
    assert report["machine"]["mujoco"].startswith("4.")
    assert report["settings"]["worlds"] == 16
    assert "seed=3" in report["settings"]["overrides"]
    assert report["machine"]["CPU"] in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--parts=speed",), "no part 'speed'; there are physics, terrain, learning, inference"),
        (("--worlds=0",), "'0' is not a number of at least 1"),
        (("--rounds=many",), "'many' is not a number of at least 1"),
    ],
)
def test_a_wrong_argument_is_explained(arguments, message, capsys):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--cfg=solo9",), "no configuration 'solo9'"),
        (("num_envs=8",), "use --worlds"),
        (("robot=cat", "--parts=physics"), "cat"),
        (("--json=nowhere/out.json",), "nowhere"),
    ],
)
def test_a_mistake_is_one_line(arguments, message, capsys):
    assert main(arguments) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert message in err


def test_rounds_are_interleaved_after_one_that_does_not_count():
    calls = []

    def variant(name):
        def run():
            calls.append(name)
            return float(len(calls))

        return run

    times = timing.interleave({"a": variant("a"), "b": variant("b")}, rounds=2)
    assert calls == ["a", "b"] * 3
    assert times == {"a": [3.0, 5.0], "b": [4.0, 6.0]}
    assert timing.ratios(times, "b", "a") == [4.0 / 3.0, 6.0 / 5.0]


class Nested:
    """Something with a method that calls another."""

    def outer(self):
        """Take 20 ms, and what `inner` takes."""
        time.sleep(0.02)
        self.inner()

    def inner(self):
        """Take 50 ms."""
        time.sleep(0.05)


def test_a_part_does_not_count_the_parts_that_it_calls():
    owner, timer = Nested(), timing.PartTimer()
    timer.wrap(owner, "outer", "outer")
    timer.wrap(owner, "inner", "inner")
    begin = time.perf_counter()
    owner.outer()
    whole = time.perf_counter() - begin
    assert timer.seconds["outer"] >= 0.02
    assert timer.seconds["inner"] >= 0.05
    assert sum(timer.seconds.values()) <= whole
    timer.unwrap()
    timer.clear()
    owner.outer()
    assert timer.seconds == {"outer": 0.0, "inner": 0.0}
