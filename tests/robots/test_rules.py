"""What a robot's file may be: what the documentation rules is checked where a robot is loaded."""

from __future__ import annotations

import re
import shutil
import struct

import numpy as np
import pytest

from kiras_rl.robots.robot import ROBOTS, RobotError, load_robot

COMPILER = '<compiler angle="radian" autolimits="true"/>'
WORLD = "<worldbody>"


def replaced(old, new):
    """Return an edit of the first place where a text stands."""

    def edit(text):
        assert old in text, old
        return text.replace(old, new, 1)

    return edit


def refusal(edit_text, file, edit):
    """Return the one line with which a changed Solo-8 is refused."""
    with pytest.raises(RobotError) as caught:
        edit_text(file, edit)
    message = str(caught.value)
    assert "\n" not in message
    return message


BROKEN = {
    "actuators": (
        replaced(
            "</mujoco>",
            '<actuator><motor name="m" joint="FL_HFE"/></actuator></mujoco>',
        ),
        "there are 1 actuators, .* remove <actuator>",
    ),
    "sensors": (
        replaced("</mujoco>", '<sensor><jointpos joint="FL_HFE"/></sensor></mujoco>'),
        "there are 1 sensors, .* remove <sensor>",
    ),
    "no free joint": (
        lambda text: re.sub(r"<freejoint[^>]*/>", "", text),
        "the first joint must be free",
    ),
    "ball joint": (
        replaced('<joint name="FL_HFE"', '<joint type="ball" range="0 1" name="FL_HFE"'),
        "joint 'FL_HFE' must be a hinge",
    ),
    "slide joint": (
        replaced('<joint name="FL_KFE"', '<joint type="slide" name="FL_KFE"'),
        "joint 'FL_KFE' must be a hinge",
    ),
    "ground of its own": (
        replaced(WORLD, f'{WORLD}<geom type="plane" size="0 0 1"/>'),
        "lies in the world, whose ground is the scene's: remove it",
    ),
    "another tree": (
        replaced(WORLD, f'{WORLD}<body name="post" pos="3 0 0"><geom size="0.1"/></body>'),
        "the first joint must be free|body 'post' must hang on 'base'",
    ),
    "name of the scene": (
        replaced(WORLD, f'{WORLD}<light name="sun"/>'),
        "lights: the name 'sun' is taken by scene.xml",
    ),
    "contact bits": (
        lambda text: re.sub(r'contype="0" conaffinity="1"', 'contype="1" conaffinity="0"', text),
        'has contype="1" conaffinity="0": it has to touch the ground alone',
    ),
    "no priority": (replaced('priority="1"', 'priority="0"'), 'needs priority="1"'),
    "not XML": (replaced(WORLD, "<worldbdy>"), "XML"),
    "mesh that is missing": (
        replaced(COMPILER, f'{COMPILER}<asset><mesh name="a" file="a.stl"/></asset>'),
        "a.stl",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_file_that_breaks_a_rule_is_refused(edit_text, name):
    edit, part = BROKEN[name]
    message = refusal(edit_text, "solo8.xml", edit)
    assert "solo8.xml: " in message
    assert re.search(part, message), message


@pytest.mark.parametrize(
    ("key", "value", "part"),
    [
        ("base_body", "FL_upper_leg", "does not carry the free joint; name 'base'"),
        ("kp", "0.0", "kp must be above 0, not 0.0"),
        ("kd", "-0.1", "kd must be at least 0"),
        ("torque_limit", "0", "torque_limit must be above 0"),
        ("torque_limit", "-1.8", "torque_limit must be above 0"),
        ("action_scale", "-0.5", "action_scale must be above 0"),
        ("kp", ".nan", "kp must be a number"),
        ("foot_geoms", "[FL_shank]", "must be spheres of one size"),
    ],
)
def test_values_of_robot_yaml_have_ranges(edit_text, key, value, part):
    def edit(text):
        return re.sub(rf"^{key}: .*$", f"{key}: {value}", text, flags=re.MULTILINE)

    if key == "base_body":
        bodies = re.findall(r'body name="(\w+)"', (ROBOTS / "solo8/solo8.xml").read_text())
        value = bodies[1]
    message = refusal(edit_text, "robot.yaml", edit)
    assert part in message
    assert "robot.yaml" in message


@pytest.mark.parametrize("name", ["walk, slow", "crawl:1", "a/b", "[red]", "$x", "7", "", "é"])
def test_names_that_commands_cannot_carry_are_refused(edit_text, name):
    message = refusal(edit_text, "keyframes.yaml", replaced("stilt:", f"'{name}':"))
    assert f"keyframe {name!r}: a name has letters, digits" in message


def test_a_robot_s_own_name_is_one_that_commands_can_carry(edit_text):
    with pytest.raises(RobotError, match="robot 'my robot': a name has letters"):
        edit_text("robot.yaml", lambda text: text, name="my robot")


def test_another_encoding_is_refused(edit_text):
    message = refusal(edit_text, "robot.yaml", lambda text: ("# ü\n" + text).encode("latin-1"))
    assert "line 1 is not UTF-8" in message


def test_legs_of_different_length_are_refused(tmp_path):
    folder = shutil.copytree(ROBOTS / "solo8", tmp_path / "solo8")
    mjcf, robot = folder / "solo8.xml", folder / "robot.yaml"
    joint = re.search(r'<joint name="FL_HFE"[^>]*/>', mjcf.read_text())[0]
    body = joint.replace("FL_HFE", "FL_HAA")
    mjcf.write_text(mjcf.read_text().replace(joint, body + joint))
    robot.write_text(robot.read_text().replace("[FL_HFE,", "[FL_HAA, FL_HFE,"))
    with pytest.raises(RobotError, match="same number of hinges, one at least, not FL_foot 3, FR_"):
        load_robot("solo8", root=tmp_path)


def test_visuals_that_weigh_something_are_refused(edit_text):
    def edit(text):
        return re.sub(r"<inertial[^>]*/>", "", text).replace('mass="0"', 'mass="0.3"')

    if "<inertial" in (ROBOTS / "solo8/solo8.xml").read_text():
        assert "heavier with its geoms of group 2" in refusal(edit_text, "solo8.xml", edit)


def test_the_world_of_the_scene_is_that_of_every_robot(edit_text):
    before = load_robot("solo8").spec().compile()
    option = (
        '<option timestep="0.001" integrator="Euler" cone="elliptic" gravity="0 0 -1.62">'
        '<flag contact="disable"/></option><statistic extent="9"/>'
    )
    default = '<default>\n<geom condim="1" friction="3"/>'
    robot = edit_text(
        "solo8.xml",
        lambda text: text.replace(COMPILER, COMPILER + option).replace("<default>", default, 1),
    )
    after = robot.spec().compile()
    assert repr(after.opt) == repr(before.opt)
    assert repr(after.stat) == repr(before.stat)
    floor, same = after.geom("floor"), before.geom("floor")
    np.testing.assert_array_equal(floor.friction, same.friction)
    assert floor.condim == same.condim


def test_meshes_lie_where_the_file_says(edit_text, tmp_path):
    folder = tmp_path / "robots" / "solo8" / "assets"
    folder.mkdir(parents=True)
    corners = [(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0, 0, 0.1)]
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    stl = b"\0" * 80 + struct.pack("<I", len(faces))
    for face in faces:
        stl += struct.pack("<12fH", 0, 0, 0, *(x for i in face for x in corners[i]), 0)
    (folder / "box.stl").write_bytes(stl)
    mesh = f'{COMPILER[:-2]} meshdir="assets"/><asset><mesh name="box" file="box.stl"/></asset>'
    robot = edit_text("solo8.xml", replaced(COMPILER, mesh))
    assert "box" in [mesh.name for mesh in robot.spec().meshes]
    shutil.rmtree(folder)


def test_every_shipped_robot_keeps_the_rules():
    for name in ("solo8", "go1"):
        assert load_robot(name).spec(visuals=False).compile().nu == len(load_robot(name).kp)
