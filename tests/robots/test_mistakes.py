"""What is said about mistakes in a robot's files and about poses that it cannot take."""

import numpy as np
import pytest

from kiras_rl.robots.robot import RobotError, load_robot
from kiras_rl.robots.statics import check_keyframe, examine_keyframe


def test_unknown_robot():
    with pytest.raises(RobotError, match=r"no robot 'solo9' \(did you mean 'solo8'\?\); "
                       r"available: .*go1, .*solo8"):  # fmt: skip
        load_robot("solo9")


def test_feet_ahead_go_with_knees(edit):
    pose = {"base_height": 0.2, "pitch": 0, "joint_pos": [0.0] * 8, "feet_ahead": 0.1}
    with pytest.raises(RobotError, match="feet_ahead goes with knees, not with joint_pos"):
        edit("keyframes.yaml", pose=pose)


def test_unknown_skill(solo8):
    with pytest.raises(RobotError, match=r"'wlak' \(did you mean 'walk'\?\); it has: walk, crawl"):
        solo8.keyframe("wlak")


MISTAKES = {
    "out of reach": (
        {"tall": {"base_height": 0.4, "pitch": 0, "knees": "back"}},
        r"keyframe 'tall' of solo8: leg length 0\.384 m needed, 0\.320 m at most: "
        r"lower base_height by 0\.064 m in .*keyframes\.yaml",
    ),
    # the front hips of a nose-up pose are 0.19 sin 30 deg = 0.095 m higher
    "out of reach when pitched": (
        {"rear": {"base_height": 0.25, "pitch": -30, "knees": "back"}},
        r"leg length 0\.329 m needed, 0\.320 m at most: lower base_height by 0\.009 m",
    ),
    "in the ground": (
        {"flat": {"base_height": 0.01, "pitch": 0, "knees": "back"}},
        r"leg length -0\.006 m needed, 0\.000 m at least: raise base_height by 0\.006 m",
    ),
    "beyond a joint limit": (
        {"twist": {"base_height": 0.2, "pitch": 0, "joint_pos": [3.5, *[0.0] * 7]}},
        r"keyframe 'twist' of solo8: FL_HFE at 3\.500 rad is 2\.050 rad outside its limits "
        r"\(-1\.450 to 1\.450\)",
    ),
    "unknown key": (
        {"walk": {"base_heigth": 0.2, "pitch": 0, "knees": "back"}},
        r"unknown key 'base_heigth' in keyframe 'walk' of solo8 .*\(did you mean 'base_height'\?\)",
    ),
    "missing key": ({"walk": {"pitch": 0, "knees": "back"}}, "missing in .*: base_height"),
    "knees and angles": (
        {"walk": {"base_height": 0.2, "pitch": 0}},
        "needs either knees or joint_pos",
    ),
    "unknown knees": (
        {"walk": {"base_height": 0.2, "pitch": 0, "knees": "backward"}},
        r"knees must be one of back, forward, inward, not 'backward' \(did you mean 'back'\?\)",
    ),
    "too few angles": (
        {"walk": {"base_height": 0.2, "pitch": 0, "joint_pos": [0.1]}},
        r"joint_pos must be a list of 8 angles in rad \(FL_HFE, .*\), not \[0\.1\]",
    ),
    "no number": (
        {"walk": {"base_height": "high", "pitch": 0, "knees": "back"}},
        "base_height must be a number, not 'high', in keyframe 'walk' of solo8",
    ),
    "no mapping": ({"walk": 0.2}, "keyframe 'walk' of solo8 .* must hold base_height, pitch"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_in_keyframes(edit, name):
    entries, message = MISTAKES[name]
    with pytest.raises(RobotError, match=message):
        edit("keyframes.yaml", **entries)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"kpp": 5.0}, r"unknown key 'kpp' in .*robot\.yaml \(did you mean 'kp'\?\); allowed: "),
        ({"kp": None}, r"missing in .*robot\.yaml: kp"),
        ({"kp": "stiff"}, "kp must be a number, not 'stiff'"),
        ({"kd": {"*_HFE": 0.1}}, "kd has no value for FL_KFE, FR_KFE, HL_KFE, HR_KFE"),
        ({"kd": {"*_HAA": 0.1}}, r"kd: '\*_HAA' fits none of FL_HFE, "),
        ({"joint_limits": 1.0}, r"joint_limits must be \[lowest, highest\], not 1\.0"),
        ({"joint_limits": [1.0, -1.0]}, r"first of \[1\.0, -1\.0\] must be the lower one"),
        ({"motor": {"stall_torque": 3.0}}, "missing in motor of .*: no_load_speed"),
        ({"motor": 3.0}, r"motor must hold stall_torque, no_load_speed, not 3\.0"),
        ({"variants": [1]}, "variants must hold"),
        ({"joints": ["FL_KFE"]}, r"MJCF's order \[FL_HFE, FL_KFE, .*\], not \['FL_KFE'\]"),
        ({"base_body": "bas"}, r"base_body: 'bas' is not in the MJCF \(did you mean 'base'\?\)"),
        ({"foot_geoms": ["FL_fot"]}, r"'FL_fot' is not in the MJCF \(did you mean 'FL_foot'\?\)"),
        ({"foot_geoms": ["FL_shank"]}, "foot_geoms FL_shank must be spheres of one size"),
        ({"default_joint_pos": "wakl"}, r"no keyframe 'wakl' \(did you mean 'walk'\?\)"),
    ],
)
def test_mistakes_in_robot_yaml(edit, entries, message):
    with pytest.raises(RobotError, match=message):
        edit("robot.yaml", **entries)


ONBOARD = load_robot("solo8").onboard


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rate": 0}, r"onboard.rate must be between 1 and 10000, not 0, in .*robot\.yaml"),
        ({"max_kp": -1.0}, r"onboard.max_kp must be above 0, not -1\.0"),
        ({"max_tilt": "steep"}, "onboard.max_tilt must be a number, not 'steep'"),
        ({"max_power": None}, "onboard.max_power must be a number, not None"),
        ({"min_battery": 10}, "onboard.min_battery must be between 0 and 1, not 10"),
        ({"needs_calibration": 1}, "onboard.needs_calibration must be true or false, not 1"),
        ({"late_ticks": [3, 1, 10]}, r"late_ticks must be three whole .*, not \[3, 1, 10\]"),
        ({"late_ticks": 3}, "late_ticks must be three whole numbers"),
        ({"max_tlit": 60.0}, r"unknown key 'max_tlit' in onboard of .*mean 'max_tilt'\?"),
    ],
)
def test_mistakes_in_onboard(edit, changes, message):
    with pytest.raises(RobotError, match=message):
        edit("robot.yaml", onboard={**ONBOARD, **changes})


def test_onboard_is_whole_or_not_there(edit):
    assert edit("robot.yaml", onboard=None).onboard is None
    with pytest.raises(RobotError, match=r"missing in onboard of .*robot\.yaml: slew"):
        edit("robot.yaml", onboard={k: v for k, v in ONBOARD.items() if k != "slew"})
    with pytest.raises(RobotError, match="onboard must hold `name: value` entries, not 3"):
        edit("robot.yaml", onboard=3)


def test_broken_yaml_is_located(edit, tmp_path):
    path = tmp_path / "solo8" / "keyframes.yaml"
    path.write_text("walk: {base_height: 0.2\n")
    with pytest.raises(RobotError, match=r"keyframes\.yaml is not valid YAML: .*line 2"):
        load_robot("solo8", root=tmp_path)


def test_broken_mjcf_is_located(edit, tmp_path):
    path = tmp_path / "solo8" / "solo8.xml"
    path.write_text(path.read_text().replace("<freejoint", "<freejiont"))
    with pytest.raises(RobotError, match=r"solo8\.xml: .*freejiont"):
        load_robot("solo8", root=tmp_path)


def test_keyframe_that_is_too_heavy(edit):
    robot = edit("robot.yaml", torque_limit=0.5)
    with pytest.raises(
        RobotError,
        match=r"keyframe 'walk' of solo8: [FH][LR]_KFE needs 0\.6[67] N m to hold it, "
        r"0\.40 N m at most \(20% below its limit\): change the pose in .*keyframes\.yaml",
    ):
        check_keyframe(robot, robot.keyframe("walk"))


def test_keyframe_that_leaves_steps_no_room(edit):
    low = {"base_height": 0.085, "pitch": 0, "knees": "back"}
    margin = 2.80 - 2.0 * float(np.arccos(0.069 / 0.32))
    robot = edit("keyframes.yaml", low=low)
    with pytest.raises(RobotError, match=rf"_KFE is {margin:.3f} rad from its limit, 0\.1 rad"):
        check_keyframe(robot, robot.keyframe("low"))


def test_keyframe_that_kneels(edit):
    # thighs at 0.945 rad put the knees 0.1 - 0.16 cos 0.945 = 0.006 m high, of 0.018 m radius
    outside = {"F*": 0.03, "H*": -0.03}
    crawl = {"base_height": 0.1, "pitch": 0, "knees": "inward", "feet_ahead": outside}
    robot = edit("keyframes.yaml", crawl=crawl)
    with pytest.raises(
        RobotError, match=r"_thigh is -0\.012 m above the ground, 0\.005 m at least"
    ):
        check_keyframe(robot, robot.keyframe("crawl"))


def test_keyframe_whose_feet_are_ahead(edit):
    walk = {
        "base_height": 0.2,
        "pitch": 0,
        "knees": "back",
        "feet_ahead": {"FL*": 0.05, "*R_*": 0.0, "HL*": 0.0},
    }
    robot = edit("keyframes.yaml", walk=walk)
    hip = float(np.arccos(np.hypot(0.184, 0.05) / 0.32) - np.arctan(0.05 / 0.184))
    assert robot.keyframe("walk").joint_pos[0] == pytest.approx(hip, abs=1e-6)
    assert robot.keyframe("walk").joint_pos[2] == pytest.approx(np.arccos(0.184 / 0.32), abs=1e-6)


def test_unknown_variant(solo8):
    with pytest.raises(RobotError, match=r"no robot 'solo8:12' \(did you mean '12A'\?\)"):
        load_robot("solo8:12")


def test_keyframe_that_floats(edit):
    pose = {"base_height": 0.35, "pitch": 0, "joint_pos": [0.0] * 8}  # stands at 0.336
    robot = edit("keyframes.yaml", floating=pose)
    with pytest.raises(RobotError, match=r"lowest foot is 0\.014 m above .* lower base_height by"):
        check_keyframe(robot, robot.keyframe("floating"))


def test_keyframe_that_tips_over(edit):
    lean = 1.0  # straight legs swung back by 1 rad: feet 0.27 m behind the hips
    height = float(0.32 * np.cos(lean) + 0.016)
    pose = {"base_height": height, "pitch": 0, "joint_pos": [lean, 0.0] * 4}
    robot = edit("keyframes.yaml", leaning=pose)
    report = examine_keyframe(robot, robot.keyframe("leaning"))
    front_feet = 0.190 - 0.32 * np.sin(lean)
    thighs, shanks = 4 * 0.14853845 * 0.078707, 4 * 0.03763607 * (0.16 + 0.102249)
    centre = -(thighs + shanks) * np.sin(lean) / 2.17784899
    assert report.imbalance == pytest.approx(centre - front_feet, abs=1e-3)
    with pytest.raises(RobotError, match=r"tips over, its centre of mass lies 0\.0\d\d m outside"):
        check_keyframe(robot, robot.keyframe("leaning"))
