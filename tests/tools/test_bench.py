"""kiras-bench: every figure is there and is what it says; mistakes are one line."""

from __future__ import annotations

import json
import shlex
import sys
import time
from itertools import pairwise
from types import SimpleNamespace

import pytest
import torch

from kiras_rl.config import load_config
from kiras_rl.robots.robot import load_robot
from kiras_rl.tools.bench import main
from kiras_rl.tools.benchmarks import scale, timing
from kiras_rl.tools.benchmarks.request import Request

SMALL = (
    *("--worlds=16", "--rounds=1", "learner.ppo.num_steps=4", "learner.ppo.num_mini_batches=2"),
    *("learner.imitation.discriminator.batch_size=32", "finetuning.env.terrain.levels=2"),
)


@pytest.fixture(autouse=True, scope="module")
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
        assert main([*SMALL, f"--out={tmp_path}", *arguments]) == 0
        return json.loads((tmp_path / "figures.json").read_text()), capsys.readouterr().out

    return run


def test_the_environment_is_measured_against_the_batch_alone(bench):
    report, out = bench("--parts=physics")
    physics = report["physics"]
    assert physics["share_of_bare_speed"]["mujoco.batch"]["median"] == 1.0
    seconds = physics["seconds_per_step"]
    shares = physics["share_of_bare_speed"]
    for variant in ("mujoco.batch without sensors", "simulation step", "environment step"):
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
    report, out = bench("--parts=terrain")
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
    report, _ = bench("--parts=learning", "learner.estimator=null", "learner.skill_init=null")
    assert list(report["learning"]["price_seconds"]) == ["imitation", "multi_critic"]


def test_the_exported_policy_is_fast_enough_for_50_hz(bench):
    inference = bench("--parts=inference")[0]["inference"]
    assert 0.0 < inference["median_seconds"] < 0.02
    assert inference["median_seconds"] <= inference["p99_seconds"]


def test_the_parts_of_an_iteration_make_the_whole_in_both_phases(bench, tmp_path):
    iteration = bench("--parts=iteration", "--plot")[0]["iteration"]
    learning, finetuning = iteration["seconds"].values()
    for part in ("physics", "act", "record", "returns", "policy update", "estimator", "rest"):
        assert learning[part] > 0.0
        assert finetuning[part] > 0.0
    assert set(learning) - set(finetuning) == {
        *("imitation scoring", "premium windows", "discriminator")
    }
    assert set(finetuning) - set(learning) == {"residual reward"}
    assert (tmp_path / "iteration.png").read_bytes().startswith(b"\x89PNG")


def layers(*widths):
    """Multiplications of a forward pass on one row, of all layers and of the first."""
    products = [a * b for a, b in pairwise(widths)]
    return sum(products), products[0]


def test_the_bound_is_physics_and_the_arithmetic_of_the_update(bench):
    report, out = bench("--parts=bound")
    bound = report["bound"]
    # A step on B rows: outputs and gradients of weights on all layers, gradients of inputs on all
    # but the first; an addition for each multiplication. 8 steps: 4 epochs of 2 mini-batches.
    rows = 16 * 4 // 2
    actor, actor_first = layers(45, 128, 128, 128, 8)
    critic, critic_first = layers(107, 128, 128, 128, 1)
    step = 2 * rows * (3 * (actor + 2 * critic) - actor_first - 2 * critic_first)
    assert bound["operations"]["policy"] == 8 * step
    assert bound["shapes"] == {
        "policy": "32 x 128 x 128",
        "estimator": "32 x 128 x 128",
        "discriminator": "64 x 512 x 256",
    }
    seconds = bound["seconds"]
    for network, count in bound["operations"].items():
        rate = bound["operations_per_second"][bound["shapes"][network]]
        assert seconds[network] == pytest.approx(count / rate)
    parts = sum(seconds[name] for name in ("bare physics", *bound["operations"]))
    assert seconds["bound"] == pytest.approx(parts)
    assert bound["share_of_bound"]["median"] == pytest.approx(
        seconds["bound"] / seconds["iteration"]
    )
    assert "target: at least 0.85" in out


@pytest.fixture(scope="module")
def options(tmp_path_factory):
    """Return the figures of the options, with one varied, and the tables: measured once."""
    out = tmp_path_factory.mktemp("options")
    assert main([*SMALL, f"--out={out}", "--parts=options", "sim.solver_iterations=6"]) == 0
    return json.loads((out / "figures.json").read_text())["options"], (out / "tables.txt")


def test_a_finer_time_step_is_nearer_to_the_reference(options):
    options, tables = options
    errors, fine = options["errors"], "timestep 0.0025 s x 8"
    assert options["speed"]["configuration"]["median"] == 1.0
    for key in ("base_position", "base_height", "pitch", "foot_force"):
        assert errors["reference"][key] == [0.0, 0.0]
        assert 0.0 < errors[fine][key][0] < errors["configuration"][key][0]
    # what a sphere of 16 mm can do without passing through the ground
    assert 0.0 < errors["configuration"]["penetration"] < 0.016
    assert "* configuration" in tables.read_text()


@pytest.mark.parametrize("name", ["figures.json", "tables.txt", "iteration.png"])
def test_files_of_others_are_spared_before_anything_is_measured(name, tmp_path, capsys):
    (tmp_path / name).write_bytes(b"mine")
    assert main([*SMALL, f"--out={tmp_path}", "--parts=iteration", "--plot"]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith(f"error: {tmp_path / name} is there and was not written by")
    assert (tmp_path / name).read_bytes() == b"mine"


def test_contacts_err_less_the_longer_they_are_searched(bench, monkeypatch, tmp_path):
    monkeypatch.setattr("kiras_rl.tools.benchmarks.contacts.POSES", 25)
    contacts = bench("--parts=contacts")[0]["contacts"]
    errors = contacts["errors"]
    assert contacts["contacts"] > contacts["poses"]
    assert errors["reference"]["depth_max"] == 0.0
    coarse, fine = errors["tolerance 1e-3"], errors["tolerance 1e-5"]
    assert 0.0 <= fine["depth_mean"] < coarse["depth_mean"] < 1e-3  # the tolerance, m
    assert "* configuration" in (tmp_path / "tables.txt").read_text()


def test_contacts_need_a_height_field(capsys):
    rough = (
        "slopes",
        "bars",
        "footholds",
        "stairs_up",
        "stairs_down",
        "pits",
        "plates",
        "ramps",
        "rough",
    )
    without = [f"finetuning.env.terrain.types.{name}=null" for name in rough]
    assert main([*SMALL, "--parts=contacts", *without]) == 2
    assert "height field" in capsys.readouterr().err


def test_contacts_need_terrain(capsys):
    assert main([*SMALL, "--parts=contacts", "finetuning.env.terrain=null"]) == 2
    assert "finetuning needs terrain" in capsys.readouterr().err


def test_options_need_a_policy_that_comes_with_the_robot(capsys, monkeypatch, tmp_path):
    bare = SimpleNamespace(folder=tmp_path)
    monkeypatch.setattr("kiras_rl.tools.shared.policy_files.load_robot", lambda name: bare)
    assert main([*SMALL, "--parts=options", "--cfg=go1"]) == 2
    assert "no policy comes with go1" in capsys.readouterr().err


def test_an_option_is_varied_once_and_the_choice_is_not_repeated(options):
    options = options[0]["options"]
    assert options["configuration"]["iterations"] == options["configuration"]["ls_iterations"] == 6
    assert "iterations 6" not in options
    assert options["iterations 10"] == options["configuration"] | {"iterations": 10}
    assert options["timestep 0.004 s x 5"] == options["configuration"] | {"substeps": 5}
    assert options["reference"]["substeps"] == 20  # of 1 ms in 20 ms


@pytest.mark.slow
def test_worlds_are_added_until_memory_is_short(bench, tmp_path):
    sizes = "--worlds=4,8,1000000000"
    report, out = bench("--parts=scale", sizes, "finetuning=null", "--plot")
    measured = report["scale"]
    assert [size["worlds"] for size in measured["sizes"]] == [4, 8]
    assert measured["stopped"].startswith("1000000000 worlds would take ")
    assert measured["stopped"] in " ".join(out.split())
    for size in measured["sizes"]:
        assert size["steps_per_second"] == pytest.approx(size["worlds"] / size["seconds_per_step"])
        assert size["memory_bytes"] > 0
    assert measured["variants"] == {}  # nothing but what was asked for
    assert [f"{n} worlds: " in out for n in (4, 8)] == [True, True]  # told before the table
    assert (tmp_path / "scale.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_what_is_in_the_worlds_is_varied(monkeypatch):
    monkeypatch.setattr(scale, "FIRST", 4)
    monkeypatch.setattr(scale, "LARGEST", {"cpu": 8})
    config = load_config("solo8", ["num_envs=4", "finetuning=null", "sim.backend=native"])
    measured = scale.measure(Request(config, rounds=1, device="cpu"))
    assert [size["worlds"] for size in measured["sizes"]] == [4, 8]
    skills = {name: variant["skills"] for name, variant in measured["variants"].items()}
    assert skills == {
        "flat ground": 5,
        "flat ground, without height_scan": 5,
        "flat ground, 1 skill": 1,
        "flat ground, 5 skills": 5,
        "flat ground, 10 skills": 10,
    }


def test_more_skills_than_a_robot_has_are_its_own_again():
    robot = load_robot("solo8")
    more = scale.with_skills(robot, 7)
    assert len(set(more.skills)) == 7
    assert more.keyframes[6].base_height == robot.keyframes[1].base_height


@pytest.fixture
def stand_in(tmp_path):
    """An interpreter that answers as mjlab's script does: 5 s for the steps of every round."""
    path, script = tmp_path / "python", tmp_path / "stand_in.py"
    # not in the first line of the script: there a path must not hold a space
    path.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} {script} "$@"\n')
    script.write_text(
        "import json, sys\n"
        "about = {'task': 'none', 'versions': {'arguments': ' '.join(sys.argv[2:])}}\n"
        "print(json.dumps(about), flush=True)\n"
        "for _ in sys.stdin:\n"
        "    print(5.0, flush=True)\n"
    )
    path.chmod(0o755)
    return path


def test_a_peer_takes_turns_with_us(bench, stand_in):
    report, out = bench(f"--peer={stand_in}", "device=cpu")
    peer = report["peer"]
    assert peer["versions"]["mjlab"] == {"arguments": "cpu 16 50"}
    assert peer["seconds_per_step"]["mjlab"]["median"] == 0.1  # 5 s, 50 steps
    assert peer["steps_per_second"]["mjlab"] == 160.0
    ours = peer["seconds_per_step"]["KiRAS-RL"]["median"]
    assert peer["times_as_fast"]["KiRAS-RL"]["median"] == pytest.approx(0.1 / ours)
    assert "KiRAS-RL" in out


@pytest.mark.parametrize(
    ("python", "message"),
    [(sys.executable, "No module named 'mjlab'"), ("/no/python", "No such file or directory")],
)
def test_a_peer_that_does_not_run_is_explained(python, message, capsys):
    assert main([*SMALL, f"--peer={python}", "device=cpu"]) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"error: --peer {python}: ")
    assert err.count("\n") == 1
    assert message in err


def test_tables_are_saved_as_they_are_printed(bench, tmp_path):
    bench("--parts=inference")
    tables = (tmp_path / "tables.txt").read_text()
    assert "exported policy, one thread" in tables
    assert "mujoco-warp" in tables


def test_the_report_says_where_and_with_what_it_was_measured(bench):
    report, out = bench("--parts=inference", "seed=3")
    assert report["machine"]["cores"] >= 1
    assert report["machine"]["mujoco"].startswith("4.")
    assert report["settings"]["worlds"] == [16]
    assert "seed=3" in report["settings"]["overrides"]
    assert report["machine"]["CPU"] in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--parts=speed",), "no part 'speed'; there are physics, terrain, learning, iteration"),
        (("--worlds=8,x",), "'x': give a whole number, at least 1"),
        (("--parts=peer",), "the part peer needs --peer PYTHON"),
        (("--plot",), "--plot needs --out FOLDER"),
        (("--worlds=0",), "'0': give a whole number, at least 1"),
        (("--rounds=many",), "'many': give a whole number, at least 1"),
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
        (("--parts=terrain", "finetuning=null"), "no terrain to measure"),
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
