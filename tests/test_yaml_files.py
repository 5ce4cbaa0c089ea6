"""One reader of YAML: what a name and a number are, and what is refused, in every file alike."""

from __future__ import annotations

import pytest

from kiras_rl.config import ConfigError, load_config
from kiras_rl.robots.robot import RobotError
from kiras_rl.tools.training.sweep import load_sweep
from kiras_rl.yaml_files import YamlError, read_yaml_file, read_yaml_text


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("on: {no: 1, 7: 2}", {"on": {"no": 1, "7": 2}}),  # names stay names
        ("[6e0, 1e-3, .5, 1_000, 0x10, 012]", [6.0, 1e-3, 0.5, 1000, 16, 12.0]),
        ("[true, yes, off, null, ~]", [True, "yes", "off", None, None]),
        ("[12:30, 2026-01-31, a.b]", ["12:30", "2026-01-31", "a.b"]),
        ("a: &a {x: 1, y: 2}\nb: {<<: *a, y: 3}", {"a": {"x": 1, "y": 2}, "b": {"x": 1, "y": 3}}),
        ("", None),
    ],
)
def test_names_and_numbers(text, value):
    assert read_yaml_text(text) == value


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("kp: 6\nkd: 1\nkp: 60", "line 3: 'kp' stands twice"),
        ("a: {b: {c: 1, c: 1}}", "line 1: 'c' stands twice"),
        ("a: &a [*a]", "nested too deeply"),
        ("[" * 9999, "nested too deeply"),
        ("? [1]\n: 2", "a key must be a name"),
        ("a: {", "line 1"),
        ("a: \x0b", "special characters are not allowed"),
        ("--- 1\n--- 2", "a single document"),
        ("a: !!python/object:os.system x", "could not determine a constructor"),
        ("a: 1" + 400 * "0", "too large for a whole number"),
        ("a: !!float b", "could not convert"),
    ],
)
def test_what_is_no_usable_yaml_is_one_line(text, part):
    with pytest.raises(YamlError, match=part) as caught:
        read_yaml_text(text)
    assert "\n" not in str(caught.value)


def test_another_encoding_is_named_with_its_line(tmp_path):
    (tmp_path / "a.yaml").write_bytes("a: 1\n# f\xfcr\n".encode("latin-1"))
    with pytest.raises(YamlError, match="line 2 is not UTF-8"):
        read_yaml_file(tmp_path / "a.yaml")


def test_a_key_that_stands_twice_is_refused_in_every_file(tmp_path):
    mine = tmp_path / "mine.yaml"
    mine.write_text("extends: smoke\nseed: 1\nseed: 2\n")
    with pytest.raises(ConfigError, match=r"mine\.yaml .*line 3: 'seed' stands twice"):
        load_config(str(mine))
    with pytest.raises(ConfigError, match="'x' stands twice"):
        load_config("smoke", ["env.rewards.terms={x: 1, x: 2}"])
    with pytest.raises(ConfigError, match="'seed' stands twice"):
        load_sweep(str(mine), [], tmp_path)


def test_a_key_that_stands_twice_is_refused_of_a_robot(edit_text):
    with pytest.raises(RobotError, match=r"robot\.yaml .*'kp' stands twice"):
        edit_text("robot.yaml", lambda text: text + "kp: 60.0\n")
    with pytest.raises(RobotError, match=r"keyframes\.yaml .*'walk' stands twice"):
        edit_text("keyframes.yaml", lambda text: text + "walk: {}\n")


def test_a_robot_s_numbers_are_those_of_configurations(edit_text):
    assert edit_text("robot.yaml", lambda text: text.replace("kp: 5.0", "kp: 5e0")).kp[0] == 5.0
    robot = edit_text("keyframes.yaml", lambda text: text.replace("stilt:", "on:"))
    assert robot.skills[2] == "on"
