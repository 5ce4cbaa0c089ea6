"""kiras-evaluate and kiras-compare on the policy that comes with Solo-8, with few robots."""

from __future__ import annotations

import csv
import io
import json
import shutil
from dataclasses import replace

import pytest
from rich.console import Console

from kiras_rl.config import load_config
from kiras_rl.envs.quadruped import QuadrupedEnv
from kiras_rl.robots.robot import load_robot
from kiras_rl.tools import compare, evaluate, train
from kiras_rl.tools.evaluate import main
from kiras_rl.tools.evaluation.evaluator import evaluation_physics
from kiras_rl.tools.evaluation.protocols import PROTOCOLS
from kiras_rl.tools.evaluation.protocols.subject import Options, Subject
from kiras_rl.tools.shared.policy_files import shipped_policy
from kiras_rl.tools.training.curves import read_scalars

SKILLS = ["walk", "crawl", "stilt", "pitch_up", "pitch_down"]
FEW = ["--robots", "2", "--trials", "1", "--duration", "2"]


def results(folder, protocol):
    """Return the results of a protocol by key."""
    content = json.loads((folder / "results.json").read_text())["results"]
    return {key: value for key, value in content.items() if key.startswith(protocol)}


def test_the_imitation_protocol_measures_the_shipped_policy(tmp_path, capsys):
    assert main(["--protocol", "imitation", "--robots", "2", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    for title in ("Distance to the keyframes", "Gait", "Nearest keyframe", "report.html"):
        assert title in printed
    (imitation,) = results(tmp_path, "imitation").values()
    assert list(imitation["skills"]) == SKILLS
    for result in imitation["skills"].values():
        assert result["falls"] == 0.0
        assert result["dtw"] == pytest.approx(120 * result["dtw_frame"])
        assert 0.05 < result["dtw_frame"] < 0.6  # it moves its legs around the keyframe
        assert result["accuracy"] > 0.95 and result["cosine"] > 0.95
        assert result["height_error"] < 0.02
        assert 1.5 < result["frequency"] < 4.0
        assert 0.02 < result["clearance"] < 0.12
        assert 1.0 < result["power"] < 15.0


def test_both_backends_measure_the_same_walk(tmp_path):
    skills = {}
    for backend in ("native", "warp"):
        command = ["--protocol", "imitation", "--robots", "1", "--nominal", "--backend", backend]
        assert main([*command, "--out", str(tmp_path / backend)]) == 0
        (imitation,) = results(tmp_path / backend, "imitation").values()
        skills[backend] = imitation["skills"]
    for skill in SKILLS:  # float64 and float32 motions part within a second, but not the gait
        native, warp = skills["native"][skill], skills["warp"][skill]
        assert warp["dtw_frame"] == pytest.approx(native["dtw_frame"], rel=0.05)
        assert warp["frequency"] == pytest.approx(native["frequency"], abs=0.9)  # two lifts
        assert warp["height_error"] == pytest.approx(native["height_error"], abs=0.001)


def test_terrain_is_crossed_level_by_level_and_gives_the_same_numbers_again(
    tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr("kiras_rl.evaluation.terrain.RADIUS", 0.6)  # m
    monkeypatch.setattr("kiras_rl.evaluation.terrain.TIME_LIMIT", 3.0)  # s
    command = ["--protocol", "terrain", "--levels", "0,1", "--trials", "1"]
    assert main([*command, "--out", str(tmp_path / "a")]) == 0
    assert "Level 0" in capsys.readouterr().out
    found = results(tmp_path / "a", "terrain")
    assert len(found) == 2
    for types in found.values():
        assert list(types) == [
            "slopes",
            "bars",
            "footholds",
            "stairs_up",
            "stairs_down",
            "pits",
            "plates",
            "ramps",
            "rough",
        ]
        for cells in types.values():
            assert list(cells) == SKILLS
            assert all(0 <= c["strict"] <= c["success"] <= c["trials"] == 1 for c in cells.values())
    level_ground = next(types for key, types in found.items() if "level=0" in key)["slopes"]
    assert sum(c["success"] for c in level_ground.values()) >= 4
    # One level by itself is what it was among others.
    assert main([*command[:2], "--levels", "1", *command[4:], "--out", str(tmp_path / "b")]) == 0
    again = results(tmp_path / "b", "terrain")
    assert again == {key: found[key] for key in again}


def test_transitions_are_measured_on_both_grounds(tmp_path, monkeypatch):
    monkeypatch.setattr(PROTOCOLS["transitions"], "HOLD", 1.5)  # s
    tiles, place = [], QuadrupedEnv.place

    def spy(self, kind, level, variant):
        tiles.extend(zip(kind.tolist(), level.tolist(), variant.tolist(), strict=True))
        place(self, kind, level, variant)

    monkeypatch.setattr(QuadrupedEnv, "place", spy)
    assert main(["--protocol", "transitions", "--trials", "1", "--out", str(tmp_path)]) == 0
    found = results(tmp_path, "transitions")
    assert len(found) == 3
    flat = next(value for key, value in found.items() if "/flat" in key)
    assert flat["settled"][0][1] == 1.0 and flat["settled"][0][0] is None
    trace = next(value for key, value in found.items() if "/trace" in key)
    assert trace["order"] == [*SKILLS, "walk"]
    assert {kind for kind, _, _ in tiles} == set(range(1, 10))  # 20 trials: every rough type
    assert {level for _, level, _ in tiles} == {3}
    assert {variant for _, _, variant in tiles} == {0, 1, 2}
    assert trace["height"]["mean"][70] == pytest.approx(0.2, abs=0.02)  # of walking, at 1.4 s
    assert trace["height"]["mean"][145] == pytest.approx(0.12, abs=0.02)  # of crawling


def test_a_policy_is_measured_by_its_own_keyframes(tmp_path, monkeypatch):
    def changed(name):
        robot = load_robot(name)
        walk = replace(robot.keyframe("walk"), base_height=0.3)
        return replace(robot, keyframes=(robot.keyframe("crawl"), walk))

    command = ["--protocol", "flat", *FEW, "--nominal", "--out"]
    assert main([*command, str(tmp_path / "before")]) == 0
    for module in ("kiras_rl.tools.shared.policy_files", "kiras_rl.envs"):
        monkeypatch.setattr(f"{module}.load_robot", changed)
    assert main([*command, str(tmp_path / "after")]) == 0
    assert results(tmp_path / "after", "flat") == results(tmp_path / "before", "flat")


def test_a_result_holds_for_the_physics_that_it_was_measured_on(tmp_path, monkeypatch):
    def key(number, **options):
        return Subject.load(None, None, tmp_path / str(number), Options(**options)).key("flat")

    standard = key(1)
    assert standard == key(2) == key(3, backend="native")
    assert standard not in (key(4, backend="warp"), key(5, nominal=True))
    slippery = load_config("solo8", ["env.randomization.friction=[0.1,0.2]"])
    with monkeypatch.context() as patch:
        patch.setattr("kiras_rl.tools.evaluation.evaluator.standard_config", lambda robot: slippery)
        assert key(6) != standard
    robot = load_robot("solo8")
    weak = replace(robot, motor=replace(robot.motor, stall_torque=robot.motor.stall_torque / 2))
    monkeypatch.setattr("kiras_rl.tools.shared.policy_files.load_robot", lambda name: weak)
    assert key(7) != standard


@pytest.mark.parametrize("protocol", ["terrain", "obstacles", "heat_map"])
def test_a_robot_without_terrain_of_its_own_has_none_to_cross(
    protocol, tmp_path, capsys, monkeypatch
):
    flat = load_config("solo8", ["finetuning=null"])
    monkeypatch.setattr(
        "kiras_rl.tools.evaluation.protocols.subject.standard_config", lambda robot: flat
    )
    assert main(["--protocol", protocol, *FEW, "--out", str(tmp_path)]) == 2
    assert "the standard configuration of solo8 has no terrain" in capsys.readouterr().err


def test_what_counts_as_a_fall_is_the_robot_s_standard():
    standard = load_config("solo8")
    trained = load_config("solo8", ["env.terminations.terms.tilted.angle=3.0"])
    assert evaluation_physics(trained, False).env.terminations == standard.env.terminations


def test_files_of_one_name_are_compared(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, policy in (("a", "flat"), ("b", "rough")):
        (tmp_path / name).mkdir()
        shutil.copy(shipped_policy("solo8").with_name(f"{policy}.onnx"), f"{name}/policy.onnx")
    command = ["old=a/policy.onnx", "new=b/policy.onnx", "--protocol", "flat", *FEW]
    assert compare.main(command) == 0
    folders = sorted(path.name for path in (tmp_path / "evaluation").iterdir())
    assert folders[0] == "policy" and folders[1].startswith("policy_") and len(folders) == 2


def test_what_a_log_does_not_hold_is_left_out_unless_asked_for(tmp_path, smoke_run):
    file = Subject.load(None, None, tmp_path / "a", Options())
    run = Subject.load(smoke_run, None, tmp_path / "b", Options())
    assert "learning" in evaluate.chosen(evaluate.ALL, [run])
    assert not {"learning", "sampling"} & set(evaluate.chosen(evaluate.ALL, [run, file]))
    assert evaluate.chosen(["sampling"], [file]) == ["sampling"]
    young = tmp_path / "young"
    shutil.copytree(smoke_run, young)
    for log in young.glob("events.*"):
        log.write_bytes(b"")
    subject = Subject.load(young, None, tmp_path / "c", Options())
    assert "learning" not in evaluate.chosen(None, [subject])


def test_policies_are_set_side_by_side_and_seeds_pooled(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for seed in (1, 2):
        (tmp_path / f"ours/seed_{seed}").mkdir(parents=True)
        shutil.copy(shipped_policy("solo8"), tmp_path / f"ours/seed_{seed}/policy.onnx")
    shutil.copy(shipped_policy("solo8"), tmp_path / "one.onnx")
    code = compare.main(["ours", "theirs=one.onnx", "--protocol", "flat", *FEW, "--out", "page"])
    assert code == 0
    page = (tmp_path / "page/report.html").read_text()
    rows = (tmp_path / "page/tables/flat_skills_on_flat_ground.csv").read_text().splitlines()
    assert rows[1].startswith("walk,ours,") and rows[2].startswith("walk,theirs,")
    assert rows[1].split(",")[2:-1] == rows[2].split(",")[2:-1]  # the same policy three times
    assert "KiRAS: ours / theirs" in page
    assert (tmp_path / "ours/seed_1/evaluation/results.json").is_file()
    assert compare.main(["x=one.onnx", "x=one.onnx"]) == 2
    assert "two policies are called 'x'" in capsys.readouterr().err


def test_skill_sampling_is_read_from_the_logs_of_all_seeds(tmp_path, smoke_run):
    runs, other = tmp_path / "tiny", ["--cfg", "smoke", "seed=2", "evaluation.interval=0"]
    shutil.copytree(smoke_run, runs / "seed_1")
    assert train.main([*other, "--runs", str(tmp_path)]) == 0
    (run,) = (tmp_path / "smoke").iterdir()
    run.rename(runs / "seed_2")
    command = [str(runs), "--protocol", "sampling", "--out", str(tmp_path / "page")]
    assert compare.main(command) == 0
    table = (tmp_path / "page/tables/sampling_probabilities.csv").read_text().splitlines()
    assert len(table) == 1 + len(SKILLS)
    for row, skill in zip(csv.reader(table[1:]), SKILLS, strict=True):
        logs = [read_scalars(runs / f"seed_{k}")[f"Skill/probability_{skill}"] for k in (1, 2)]
        assert row[:2] == ["tiny", skill]
        assert [iterations for iterations, _ in logs] == 2 * [[1, 2, 3, 4]]
        end_of_learning, end = (sum(values[i] for _, values in logs) / 2 for i in (1, 3))
        assert [float(x) for x in row[4:]] == pytest.approx([100 * end_of_learning, 100 * end])


def test_learning_is_read_from_the_log_of_a_run(tmp_path, smoke_run):
    run = tmp_path / "run"
    shutil.copytree(smoke_run, run)
    assert main([str(run), "--protocol", "learning", "--out", str(tmp_path / "page")]) == 0
    log, config = read_scalars(run), load_config("smoke")
    (curves,) = PROTOCOLS["learning"].measure(Subject.load(run, None, None, Options()))["curves"]
    iterations = [i for i in log["Eval_walk/height"][0] if i <= config.iterations]
    steps = config.num_envs * config.learner.ppo.num_steps
    assert curves["steps"] == [i * steps / 1e6 for i in iterations]
    seconds = sum(steps / v for v in log["Perf/steps_per_second"][1][: iterations[-1]])
    assert curves["minutes"][-1] == pytest.approx(seconds / 60)
    errors = [log[f"Eval_{skill}/height_error"][1][0] for skill in SKILLS]
    assert curves["height_error"][0] == pytest.approx(100 * sum(errors) / len(SKILLS))
    (table,) = (tmp_path / "page/tables").glob("learning*")
    (row,) = csv.DictReader(table.read_text().splitlines())
    assert row["all skills first at the floor [M steps]"] == ""  # four iterations teach nothing


def test_progress_moves_with_every_step(tmp_path):
    options = Options(robots=1, duration=2.0, backend="native")
    subject, shares = Subject.load(None, None, tmp_path, options), []
    subject.progress.show = shares.append
    PROTOCOLS["flat"].measure(subject)
    # 100 steps of an episode that has a second to spare
    assert shares == pytest.approx([step / 150 for step in range(1, 101)])


def test_progress_counts_what_is_still_to_be_measured(tmp_path):
    subject, shares = Subject.load(None, None, tmp_path, Options()), []
    subject.progress.show = shares.append
    subject.ledger.get("known", dict)

    def half():
        subject.progress.tell(0.5)
        return {}

    subject.results({"known": half, "first": half, "second": half})
    assert shares == [0.25, 0.75]


def test_a_terminal_shows_a_bar_and_a_file_a_line_a_protocol(tmp_path, capsys, monkeypatch):
    command = ["--protocol", "flat", *FEW, "--out", str(tmp_path)]
    screen = Console(file=io.StringIO(), force_terminal=True, width=120)
    with monkeypatch.context() as patch:
        patch.setattr(evaluate, "console", screen)
        assert main(command) == 0
    assert "flat (1 of 1): solo8/flat" in screen.file.getvalue()
    assert main(command) == 0
    assert capsys.readouterr().out.startswith("measuring flat (1 of 1)\n")


@pytest.mark.parametrize("option", ["--robots", "--trials"])
@pytest.mark.parametrize("value", ["0", "-3", "many"])
def test_a_number_that_cannot_be_is_refused(option, value, capsys):
    with pytest.raises(SystemExit) as exit_info:
        main([f"{option}={value}"])
    assert exit_info.value.code == 2
    assert f"'{value}': give a whole number, at least 1" in capsys.readouterr().err


def test_mistakes_are_one_line(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["--protocol", "steps"])
    assert "unknown protocol 'steps'; allowed are all, flat" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["--levels", "4,11"])
    assert "'4,11': give levels from 0 to 10" in capsys.readouterr().err
    assert main(["--protocol", "sampling", "--out", str(tmp_path)]) == 2
    assert "lies in no run folder" in capsys.readouterr().err
    assert main([str(tmp_path)]) == 2
    assert "error: " in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["--duration", "1"])
    assert "'1': give seconds, more than 1" in capsys.readouterr().err
    (tmp_path / "file").touch()
    assert main(["--protocol", "flat", *FEW, "--out", str(tmp_path / "file")]) == 2
    message = capsys.readouterr().err
    assert message.startswith("error: ") and message.count("\n") == 1 and "file" in message
    assert main(["--device", "gpu", "--protocol", "flat", *FEW]) == 2
    assert "device=gpu: allowed are auto, cpu, cuda" in capsys.readouterr().err
