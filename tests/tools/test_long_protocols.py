"""The protocols that take long, from the command to the report: few trials, short ways."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from typing import NamedTuple

import pytest

from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.tools.evaluate import main
from kiras_rl.tools.evaluation.protocols import robustness
from kiras_rl.tools.evaluation.protocols.subject import Subject

SKILLS = ["walk", "crawl", "stilt", "pitch_up", "pitch_down"]


class Protocol(NamedTuple):
    """What a protocol is asked for, how many results it has, and after which step it is stopped."""

    options: list[str]
    results: int
    stop: int


PROTOCOLS = {
    "obstacles": Protocol(["--trials", "1"], results=3, stop=75),
    "heat_map": Protocol(["--trials", "1", "--robots", "1"], results=16, stop=125),
    "robustness": Protocol(["--robots", "1"], results=26, stop=100),
}


@pytest.fixture(scope="module")
def short():
    """Let ways and times be short: 0.35 m within 1 s on terrain, 1.1 s of two values each."""
    sweeps = robustness.sweeps
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("kiras_rl.evaluation.terrain.RADIUS", 0.35)
        patch.setattr("kiras_rl.evaluation.terrain.TIME_LIMIT", 1.0)
        patch.setattr(robustness, "DURATION", 1.1)
        patch.setattr(
            robustness,
            "sweeps",
            lambda config: [
                replace(s, values=s.values[:: len(s.values) - 1]) for s in sweeps(config)
            ],
        )
        yield


@pytest.fixture(scope="module", params=PROTOCOLS)
def finished(request, short, tmp_path_factory):
    """Stop a protocol by Ctrl-C, give the same command again; return its name and folder."""
    protocol, folder = PROTOCOLS[request.param], tmp_path_factory.mktemp(request.param)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OnboardPolicy, "infer", _interrupted(protocol.stop))
        assert evaluate(request.param, folder) == 130
    assert 0 < len(results(folder)) < protocol.results
    assert not (folder / "report.html").exists()
    assert evaluate(request.param, folder) == 0
    assert len(results(folder)) == protocol.results
    return request.param, folder


def _interrupted(steps):
    """Return `infer` that is interrupted after so many steps."""
    infer, left = OnboardPolicy.infer, iter(range(steps))

    def act(self, *args):
        if next(left, None) is None:
            raise KeyboardInterrupt
        return infer(self, *args)

    return act


def evaluate(name, folder):
    options = [*PROTOCOLS[name].options, "--backend", "native"]
    return main(["--protocol", name, *options, "--out", str(folder)])


def results(folder):
    return json.loads((folder / "results.json").read_text())["results"]


def read(folder, table):
    """Return the rows of a table by their first cell."""
    text = (folder / "tables" / f"{table}.csv").read_text()
    rows = csv.DictReader(text.splitlines())
    return {next(iter(row.values())): row for row in rows}


def test_the_report_shows_every_cell(finished):
    name, folder = finished
    CELLS[name](folder)
    page = (folder / "report.html").read_text()
    for table in folder.glob("tables/*.csv"):
        first = next(iter(read(folder, table.stem)))
        assert f">{first}<" in page


def check_obstacles(folder):
    sizes = {"slope_up": ["15 degrees", "25 degrees", "35 degrees", "45 degrees"]}
    sizes |= {f"stairs_{way}": ["5 cm", "8 cm", "10 cm", "15 cm"] for way in ("up", "down")}
    for course, rows in sizes.items():
        table = read(folder, f"obstacles_{course}")
        assert list(table) == rows
        for row in table.values():
            assert list(row) == ["size", *SKILLS]
            for skill in SKILLS:
                success, feet_only, strict = map(int, row[skill].split(" / "))
                assert max(feet_only, strict) <= success <= 100
    assert read(folder, "obstacles_the_paper_s_hardware")["stairs up, 15 cm"]["walk [%]"] == "80.0"


def check_heat_map(folder):
    measured = results(folder)
    for table, kind, size in (
        ("s_up_steps_up_of_6_cm", "stairs_up", 6),
        ("s_down_steps_down_of_6_cm", "stairs_down", 6),
        ("d_gaps_of_8_cm", "footholds", 8),
    ):
        (cells,) = (v for k, v in measured.items() if f"type={kind} cm={size} " in k)
        rows = read(folder, f"heat_map_{table}")
        assert list(rows) == [*SKILLS, "all"]
        for skill, counts in cells.items():
            assert rows[skill]["trials"] == "1"
            for shown in ("success", "feet_only", "strict", "kept"):
                column = shown.replace("_", " ")
                assert rows[skill][f"{column} [%]"].startswith(f"{100 * counts[shown]} [")
                assert counts[shown] <= counts["success"]
            assert float(rows[skill]["falls [%]"]) == 100 * counts["fell"]
        assert rows["all"]["trials"] == "5"
    page = (folder / "report.html").read_text()
    assert all(f"Heat map: {kind}" in page for kind in ("success", "feet_only", "kept"))
    others = [f"steps {way} of {x} cm" for way in ("up", "down") for x in (4, 8, 10, 12)]
    others += ["bars of 6 cm", *(f"gaps of {x} cm" for x in (4, 6, 10))]
    assert list(read(folder, "heat_map_other_sizes_solo8_flat")) == others


def check_robustness(folder):
    values = {
        "push": ["0", "1.5"],
        "payload": ["-0.5", "1.5"],
        "leg_mass": ["0.7", "1.5"],
        "friction": ["1.25", "0.02"],
        "action_delay": ["0", "40"],
        "observation_delay": ["0", "20"],
        "torque_limit": ["1.2", "0.5"],
        "motor_strength": ["0", "0.4"],
        "joint_friction": ["0", "8"],
        "joint_damping": ["0", "100"],
        "encoder_bias": ["0", "0.1"],
        "imu_tilt": ["0", "0.1"],
        "gyro_bias": ["0", "0.5"],
    }
    for name, rows in values.items():
        table = read(folder, f"robustness_{name}")
        assert list(table) == rows
        for row in table.values():
            shares = [float(row[f"{skill} [%]"]) for skill in SKILLS]
            assert float(row["all [%]"]) == pytest.approx(sum(shares) / 5)
            assert float(row["did not fall [%]"]) >= float(row["all [%]"])
    assert float(read(folder, "robustness_torque_limit")["1.2"]["did not fall [%]"]) == 100.0


CELLS = {
    "obstacles": check_obstacles,
    "heat_map": check_heat_map,
    "robustness": check_robustness,
}


def test_only_what_is_missing_is_measured_and_it_is_the_same_again(finished, tmp_path):
    name, folder = finished
    content = json.loads((folder / "results.json").read_text())
    all_of_them = content["results"]
    first, *_, last = all_of_them
    content["results"] = {key: all_of_them[key] for key in all_of_them if key not in (first, last)}
    (tmp_path / "results.json").write_text(json.dumps(content))
    with pytest.MonkeyPatch.context() as patch:
        measured, infer = [], OnboardPolicy.infer
        patch.setattr(
            OnboardPolicy, "infer", lambda self, *args: measured.append(1) or infer(self, *args)
        )
        assert evaluate(name, tmp_path) == 0
    assert 0 < len(measured) <= 2 * 180  # steps of the longest two results
    assert results(tmp_path) == all_of_them
    assert (tmp_path / "report.html").read_text() == (folder / "report.html").read_text()


def test_robustness_solves_contacts_on_ice(short, tmp_path, monkeypatch):
    """With the 6 solver iterations of training robots fall on ice that do not with 20."""
    make_env, iterations = Subject.make_env, []

    def noting(self, *args):
        env = make_env(self, *args)
        iterations.append(env.sim.model.opt.iterations)
        return env

    monkeypatch.setattr(Subject, "make_env", noting)
    assert evaluate("robustness", tmp_path) == 0
    assert set(iterations) == {20}
