"""Every reward term on one step whose numbers are chosen, and the sum's rules."""

from __future__ import annotations

import inspect
import math

import pytest
import torch

from kiras_rl.config import ConfigError
from kiras_rl.envs import rewards
from kiras_rl.envs.rewards import RewardSum, air_time, descent, stance_time, swing_peak
from kiras_rl.envs.state import Keyframes, Limits, RobotState, Step, Task
from kiras_rl.schema import RewardConfig

WALK, CRAWL = 0, 1
CONSTANT = [[0.0, 1.0]]  # factor of penalties
KEYFRAMES = Keyframes(
    height=torch.tensor([0.2, 0.1]),
    clearance=torch.tensor([0.06, 0.04]),
    pitch=torch.zeros(2),
    joint_pos=torch.tensor([[0.5, -1.0], [1.0, -2.0]]),
    gravity_b=torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, -1.0]]),
    code=torch.eye(2),
)


def row(*values):
    """Return one world's numbers."""
    return torch.tensor([values])


def crafted(command=(0.5, 0.0, 0.2), fresh=False, fallen=False):
    """Return a step of one world with two joints, two feet and two other geoms."""
    robot = RobotState.at_rest(KEYFRAMES, torch.tensor([CRAWL]), geoms=(2, 1, 2))
    robot.base_height = torch.tensor([0.15])
    robot.gravity_b = row(0.6, 0.0, -0.8)
    robot.base_lin_vel_h = row(0.3, -0.1, 0.05)
    robot.base_ang_vel_b = row(-0.2, 0.4, -0.5)
    robot.yaw_rate = torch.tensor([0.5])
    robot.joint_pos = row(0.7, -1.7)
    robot.joint_vel = row(0.6, -0.4)
    robot.joint_torque = row(2.0, -1.0)
    robot.foot_contact = torch.tensor([[True, False]])
    robot.foot_stands = robot.foot_contact
    robot.peak_torque = row(2.0, 1.2)
    robot.foot_vel_w = torch.tensor([[[0.3, -0.4, 9.0], [5.0, 5.0, 5.0]]])
    robot.foot_force = row(60.0, 12.0)
    robot._foot_height = row(0.01, 0.08)
    robot.limb_force = row(0.05, 3.0)
    first, second = [[3.0, 4.0, -2.0], [1.0, 0.0, 9.0]], [[0.0, 6.0, 5.0], [9.0, 0.0, 0.0]]
    robot._foot_forces_w = torch.tensor([[first, second]])  # of two physics steps, two feet each
    return Step(
        robot=robot,
        task=Task.of(row(*command), torch.tensor([CRAWL]), torch.tensor([WALK])),
        keyframes=KEYFRAMES,
        action=row(1.0, 2.0),
        last_action=row(-2.0, 6.0),
        last_joint_vel=row(0.5, 0.0),
        last_joint_torque=row(1.0, 1.0),
        stands=torch.tensor([math.hypot(*command) < 0.1]),
        limits=Limits(
            low=torch.tensor([-1.0, -1.5]),
            high=torch.tensor([0.6, 2.0]),
            velocity=torch.tensor([30.0, 30.0]),
            torque=torch.tensor([2.0, 4.0]),
        ),
        target=row(0.4, -1.4),
        memory={
            air_time: row(0.12, 0.5),
            stance_time: row(0.0, 0.1),
            swing_peak: row(0.03, 0.02),
            descent: row(0.8, 0.3),
        },
        fresh=torch.tensor([fresh]),
        fallen=torch.tensor([fallen]),
        weight=20.0,
        dt=0.02,
    )


def value(name, step, **parameters):
    """Return a term's value with weight 1."""
    config = RewardConfig(False, CONSTANT, {name: {"weight": 1.0} | parameters}, None)
    return RewardSum(config, step.dt, torch.device("cpu"))(step).item()


EXPECTED = {
    "tracking_lin_vel": ({"sigma": 0.25}, math.exp(-(0.2**2) / 0.25)),
    "tracking_ang_vel": ({"sigma": 0.25}, math.exp(-(0.3**2) / 0.25)),
    "action_rate": ({}, 5.0),  # |(3, -4)|
    "action_rate_squared": ({}, 25.0),
    "torques": ({}, 4.0 + 1.0),
    "delta_torques": ({}, 1.0 + 4.0),
    "joint_acceleration": ({}, (0.1**2 + 0.4**2) / 0.02**2),
    "ang_vel_xy": ({}, 0.04 + 0.16),
    "ang_vel_x_abs": ({}, 0.2),
    "ang_vel_z_abs": ({}, 0.5),
    "lin_vel_y": ({}, 0.01),
    "lin_vel_y_abs": ({}, 0.1),
    "lin_vel_z": ({}, 0.05**2),
    "foot_slip": ({}, 0.09 + 0.16),  # the second foot is in the air
    "feet_air_time": ({"target": 0.1}, 0.02),  # the other foot is still in the air
    "short_swing": ({"least": 0.16}, 0.04 / 0.16),
    "short_stance": ({"least": 0.2}, 0.5),  # of the foot that lifts off now
    "low_swing": ({"factor": 1.5}, (1 - 0.03 / 0.06) ** 2),  # crawl's clearance is 4 cm
    "hard_landing": ({"most": 0.5}, 0.3**2),  # of the foot that stands now
    "idle_feet": ({"most": 0.11}, 2.0),  # both have been in the air for longer
    "flight": ({"feet": 2}, 1.0),
    "joint_limits": ({"margin": 0.1}, (0.7 - 0.5) + (1.7 - 1.4)),  # the targets are just inside
    "torque_limits": ({"share": 0.8}, 0.2),
    "feet_drag": ({}, -(0.3 + 0.4)),
    "foot_clearance": ({"height": 0.05}, 0.04 * 0.5),  # the other foot is high enough
    "feet_contact_forces": ({"threshold": 10.0, "largest": 20.0}, 20.0 + 2.0),
    "limb_load": ({}, (0.05 + 3.0) / 20.0),
    "stumble": ({"friction": 1.0}, (3.0 + 9.0) / 20.0),
    "edge_landing": ({"reach": 0.02, "drop": 0.02}, 0.0),  # the ground is flat
    "collision": ({"threshold": 0.1}, 1.0),
    "stand_still": ({}, 0.0),
    "stand_still_pose": ({}, 0.0),
    "raised_feet": ({}, 0.0),
    "skill_height": ({"sigma": 0.05}, math.exp(-1.0)),  # 5 cm above crawl
    "skill_orientation": ({"sigma": 0.4}, math.exp(-(0.6**2 + 0.2**2) / 0.16)),
    "termination": ({}, 0.0),
}


@pytest.mark.parametrize("name", EXPECTED)
def test_a_term_s_value(name):
    parameters, expected = EXPECTED[name]
    assert value(name, crafted(), **parameters) == pytest.approx(expected, rel=1e-5)


def test_every_term_is_tested():
    terms = {
        name for name, f in inspect.getmembers(rewards, inspect.isfunction)
        if f.__module__ == rewards.__name__ and not name.startswith("_")
        and f not in (air_time, stance_time, swing_peak, descent)
    }  # fmt: skip
    assert terms == set(EXPECTED)


def test_sideways_errors_count_as_much_as_they_are_asked_to():
    expected = math.exp(-(0.2**2 + 2.0 * 0.1**2) / 0.25)
    assert value("tracking_lin_vel", crafted(), sigma=0.25, lateral=2.0) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("command", "stands"),
    [((0.0, 0.0, 0.0), True), ((0.09, 0.0, 0.0), True), ((0.0, 0.0, 0.11), False)],
)
def test_standing_still_is_asked_for_by_a_small_command(command, stands):
    step = crafted(command)
    assert value("stand_still", step) == pytest.approx(0.6 + 0.4 if stands else 0.0)
    assert value("raised_feet", step) == (1.0 if stands else 0.0)
    # from the keyframe of the commanded skill: (1, -2)
    assert value("stand_still_pose", step) == pytest.approx(0.3 + 0.3 if stands else 0.0)


GAIT = (
    *("feet_air_time", "short_swing", "short_stance", "low_swing", "hard_landing"),
    *("idle_feet", "flight"),
)


@pytest.mark.parametrize("name", GAIT)
def test_feet_of_a_robot_that_stands_are_left_alone(name):
    parameters, _ = EXPECTED[name]
    assert value(name, crafted((0.0, 0.0, 0.0)), **parameters) == 0.0


def test_swings_and_stances_that_are_long_and_high_enough_cost_nothing():
    step = crafted()
    step.memory = {air_time: row(0.2, 0.5), stance_time: row(0, 0.3), swing_peak: row(0.09, 0)}
    for name in ("short_swing", "short_stance", "low_swing"):
        assert value(name, step, **EXPECTED[name][0]) == 0.0


def test_targets_beyond_limits_cost_as_much_as_joints():
    step = crafted()
    step.target = row(0.7, -1.4)  # the first 0.1 rad above its limit of 0.6
    inside = value("joint_limits", crafted(), margin=0.0)
    assert value("joint_limits", step, margin=0.0) == pytest.approx(inside + 0.1)


def test_the_first_step_has_no_change_of_torque():
    assert value("delta_torques", crafted(fresh=True)) == 0.0


def test_a_fall_is_told():
    assert value("termination", crafted(fallen=True)) == 1.0


@pytest.mark.parametrize(("scale_by_dt", "factor"), [(False, 1.0), (True, 0.02)])
def test_terms_are_weighed_and_scaled(scale_by_dt, factor):
    terms = {"torques": {"weight": -0.1}, "action_rate": None, "lin_vel_y_abs": {"weight": 3.0}}
    total = RewardSum(RewardConfig(scale_by_dt, CONSTANT, terms, None), 0.02, torch.device("cpu"))
    assert total.names == ["torques", "lin_vel_y_abs"]
    expected = torch.tensor([[-0.5, 0.3]]) * factor
    torch.testing.assert_close(total(crafted()), expected)


def test_a_limb_that_bears_more_than_the_weight_counts_once():
    step = crafted()
    step.robot.limb_force = row(50.0, 10.0)
    assert value("limb_load", step) == pytest.approx(1.0 + 0.5)


def test_errors_of_posture_within_the_slack_cost_nothing():
    step = crafted()  # 5 cm above crawl
    assert value("skill_height", step, sigma=0.05, slack=0.05) == pytest.approx(1.0)
    assert value("skill_height", step, sigma=0.05, slack=0.02) == pytest.approx(math.exp(-(0.6**2)))
    error = math.hypot(0.6, 0.2)
    expected = math.exp(-(((error - 0.1) / 0.4) ** 2))
    assert value("skill_orientation", step, sigma=0.4, slack=0.1) == pytest.approx(expected)


def test_a_penalty_may_be_whole_from_the_start():
    terms = {"torques": {"weight": -0.1, "whole": True}, "action_rate": {"weight": -0.1}}
    total = RewardSum(RewardConfig(False, [[0.0, 0.5], [1.0, 1.0]], terms, None), 0.02, "cpu")
    total.set_progress(0.0)
    torch.testing.assert_close(total(crafted()), torch.tensor([[-0.5, -0.25]]))
    with pytest.raises(ConfigError, match=r"torques\.whole=2: must be true"):
        RewardSum(
            RewardConfig(False, CONSTANT, {"torques": {"weight": 1, "whole": 2}}, None), 1, "cpu"
        )


def test_weights_and_penalties_follow_their_schedules():
    terms = {"torques": {"weight": [[0.0, -0.1], [0.5, -0.3]]}, "lin_vel_y_abs": {"weight": 3.0}}
    config = RewardConfig(False, [[0.0, 0.5], [1.0, 1.0]], terms, None)
    total = RewardSum(config, 0.02, torch.device("cpu"))
    for progress, weight in ((0.0, -0.1 * 0.5), (0.25, -0.2 * 0.625), (1.0, -0.3)):
        total.set_progress(progress)
        torch.testing.assert_close(total(crafted()), torch.tensor([[5.0 * weight, 0.3]]))


@pytest.mark.parametrize(
    ("terms", "message"),
    [
        ({"torque": {"weight": 1.0}}, "no term 'torque': did you mean 'torques'?"),
        ({"torques": {"weight": 1.0, "sigma": 2.0}}, "torques: unknown parameter 'sigma'"),
        ({"torques": {}}, "torques: no weight; it takes weight"),
        ({"torques": -0.1}, "torques: give a weight, as in torques: {weight: 1.0}"),
        ({"collision": {"weight": 1.0}}, "collision: missing a required argument: 'threshold'"),
    ],
)
def test_a_term_that_cannot_be_is_refused(terms, message):
    with pytest.raises(ConfigError) as caught:
        RewardSum(RewardConfig(False, CONSTANT, terms, None), 0.02, torch.device("cpu"))
    assert message in str(caught.value)


def test_with_a_sigma_penalties_take_a_share_of_what_is_earned():
    config = RewardConfig(False, CONSTANT, {"torques": {"weight": -1.0}}, None)
    terms = torch.tensor([[2.0, 1.0, -1.0, -0.5], [0.0, 0.0, -3.0, 0.0]])
    assert RewardSum(config, 1, "cpu").total(terms).tolist() == [1.5, -3.0]
    config.sigma = 0.5
    composed = RewardSum(config, 1, "cpu").total(terms)
    torch.testing.assert_close(composed, torch.tensor([3.0, 0.0]) * math.exp(-1.5 / 0.5))
