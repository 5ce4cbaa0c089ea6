"""The deterministic evaluation's numbers, on recordings that can be judged by eye."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import pytest
import torch

from kiras_rl.evaluation.flat import (
    FLOOR,
    Recording,
    SkillResult,
    as_scalars,
    moving_average,
    score,
    summarize,
)

DT, STEPS = 0.1, 30  # the first ten steps are the second that does not count
KEYFRAMES = SimpleNamespace(
    step_dt=DT,
    skills=("low", "high"),
    keyframe_height=torch.tensor([0.2, 0.3]),
    keyframe_pitch=torch.tensor([0.0, 0.1]),
    keyframe_clearance=torch.tensor([0.04, 0.08]),
)
PERFECT = SkillResult(
    height=0.2, pitch=0.0, velocity=0.3, height_error=0.0, pitch_error=0.0, velocity_error=0.0,
    lifts=2.0, most_lifts=3.0, clearance=1.2, duty=0.5, beyond=0.0, saturated=0.0, power=5.0,
    distinct=1.0, falls=0.0,
)  # fmt: skip


@pytest.fixture
def recording():
    """Four robots, two a skill, that hold their keyframes, walk at the command and never fall."""
    skill = torch.tensor([0, 1, 0, 1])
    return Recording(
        skill=skill,
        command=torch.tensor([[0.3, 0.0, 0.0]]).repeat(4, 1),
        height=KEYFRAMES.keyframe_height[skill].repeat(STEPS, 1),
        pitch=KEYFRAMES.keyframe_pitch[skill].repeat(STEPS, 1),
        velocity=torch.full((STEPS, 4), 0.3),
        stands=(torch.arange(STEPS)[:, None, None] % 4 < 2).expand(STEPS, 4, 2).clone(),
        foot_height=torch.full((STEPS, 4, 2), 0.04),
        beyond=torch.zeros(STEPS, 4, dtype=torch.bool),
        saturated=torch.zeros(STEPS, 4),
        power=torch.full((STEPS, 4), 7.0),
        alive=torch.ones(STEPS, 4, dtype=torch.bool),
        step_dt=DT,
    )


def test_a_robot_in_its_keyframe_has_no_error(recording):
    for name, result in summarize(recording, KEYFRAMES).items():
        index = KEYFRAMES.skills.index(name)
        assert result.height == pytest.approx(KEYFRAMES.keyframe_height[index].item())
        assert result.pitch == pytest.approx(KEYFRAMES.keyframe_pitch[index].item())
        assert result.velocity == pytest.approx(0.3)
        errors = (result.height_error, result.pitch_error, result.velocity_error, result.falls)
        assert errors == pytest.approx((0, 0, 0, 0), abs=1e-6)
        assert result.distinct == 1.0


def test_errors_are_averaged_over_the_robots_of_a_skill(recording):
    recording.height[:, 0] += 0.02
    recording.height[:, 2] -= 0.04
    recording.pitch[:, 1] += 0.1
    recording.velocity[::2, 3] += 0.2
    low, high = summarize(recording, KEYFRAMES).values()
    assert low.height == pytest.approx(0.19)
    assert low.height_error == pytest.approx(0.03)
    assert high.pitch_error == pytest.approx(0.05)
    assert high.velocity == pytest.approx(0.35)
    assert high.velocity_error == pytest.approx(0.05)


def test_the_bounce_of_a_gait_is_no_height_error_but_a_change_of_speed_is_one(recording):
    bounce = 0.03 * torch.tensor([1.0, 1.0, -1.0, -1.0]).repeat(8)[:STEPS, None]
    recording.height.add_(bounce)
    recording.velocity.add_(bounce)
    low = summarize(recording, KEYFRAMES)["low"]
    assert low.height_error == pytest.approx(0.0, abs=1e-6)
    assert low.velocity_error == pytest.approx(0.03)


def test_the_first_second_does_not_count(recording):
    recording.height[:7] += 1.0  # the average of step 10 begins at step 7
    recording.velocity[:10] += 1.0
    low = summarize(recording, KEYFRAMES)["low"]
    assert (low.height_error, low.velocity_error) == pytest.approx((0, 0), abs=1e-6)


def test_a_robot_counts_until_it_falls(recording):
    recording.alive[20:, 0] = False
    recording.height[20:, 0] = 9.0
    recording.velocity[20:, 0] = 9.0
    low, high = summarize(recording, KEYFRAMES).values()
    assert (low.falls, high.falls) == (0.5, 0.0)
    assert low.height == pytest.approx(0.2)
    assert (low.height_error, low.velocity_error) == pytest.approx((0, 0), abs=1e-6)


def test_a_robot_that_falls_at_once_still_has_numbers(recording):
    recording.alive[3:, :] = False
    for result in summarize(recording, KEYFRAMES).values():
        assert result.falls == 1.0
        assert all(torch.isfinite(torch.tensor(x)) for x in dataclasses.astuple(result))


def test_a_robot_that_falls_in_the_first_second_counts_until_its_fall(recording):
    recording.alive[5:, 0] = False
    recording.velocity[:5, 0] = 0.1
    recording.velocity[5:, 0], recording.height[5:, 0] = 0.3, 9.0  # its next life
    recording.pitch[:, 2] = 0.2  # the other robot of the skill
    low = summarize(recording, KEYFRAMES)["low"]
    assert (low.velocity, low.velocity_error) == pytest.approx((0.2, 0.1))
    assert (low.height, low.height_error) == pytest.approx((0.2, 0.0), abs=1e-6)
    assert low.pitch == pytest.approx(0.1)
    assert low.falls == 0.5


def test_a_robot_in_another_skill_s_keyframe_is_not_distinct(recording):
    recording.height[:, 0] = 0.3
    recording.pitch[:, 0] = 0.1
    recording.height[:, 2] = 0.24  # still nearer to its own
    low, high = summarize(recording, KEYFRAMES).values()
    assert (low.distinct, high.distinct) == (0.5, 1.0)


def test_the_foot_that_lifts_least_counts(recording):
    recording.stands[:, 2, 1] = True  # the others lift at steps 14, 18, 22 and 26 of 10 to 29
    low, high = summarize(recording, KEYFRAMES).values()
    assert (low.lifts, high.lifts) == pytest.approx((1.0, 2.0))
    assert (low.most_lifts, high.most_lifts) == pytest.approx((2.0, 2.0))
    assert (low.duty, high.duty) == pytest.approx((0.625, 0.5))


def test_limits_and_power_are_shares_and_means_of_the_steps_that_count(recording):
    recording.beyond[:15, 0] = True  # 5 of the 20 steps that count, of one of two robots
    recording.saturated[20:, 1] = 0.5
    recording.power[:, 3] = 9.0
    low, high = summarize(recording, KEYFRAMES).values()
    assert (low.beyond, high.beyond) == pytest.approx((0.125, 0.0))
    assert (low.saturated, high.saturated) == pytest.approx((0.0, 0.125))
    assert (low.power, high.power) == pytest.approx((7.0, 8.0))


def test_steps_are_as_high_as_the_skill_asks(recording):
    recording.foot_height[14:16, 0] = 0.06  # the second of five whole swings
    recording.foot_height[12, 0] = 0.50  # when it lands
    low, high = summarize(recording, KEYFRAMES).values()
    assert high.clearance == pytest.approx(0.04 / 0.08)
    assert low.clearance == pytest.approx((0.044 / 0.04 + 1.0) / 2)


def test_the_average_looks_back_four_tenths_of_a_second():
    signal = torch.tensor([[0.0], [4.0], [8.0], [0.0], [4.0]])
    assert moving_average(signal, DT).squeeze(1).tolist() == [0.0, 1.0, 3.0, 3.0, 4.0]


def test_the_score_is_zero_when_perfect_and_one_at_a_limit():
    assert score({"a": PERFECT}) == 0.0
    at_limit = dataclasses.replace(PERFECT, height_error=0.03)
    assert score({"a": at_limit}) == pytest.approx(1.0)
    assert score({"a": at_limit, "b": PERFECT}) == pytest.approx(0.5)
    still = dataclasses.replace(PERFECT, lifts=0.0, velocity_error=0.12)
    assert score({"a": still}) == pytest.approx(2.0)
    for worse in ({"clearance": 0.5}, {"most_lifts": 4.5}, {"beyond": 0.1}, {"saturated": 0.1}):
        assert score({"a": dataclasses.replace(PERFECT, **worse)}) == pytest.approx(1.0)


@pytest.mark.parametrize(
    "worse",
    [{"height_error": 0.04}, {"pitch_error": 0.1}, {"velocity_error": 0.2}, {"falls": 0.1},
     {"lifts": 0.5}, {"most_lifts": 5.0}, {"clearance": 0.4}, {"beyond": 0.02},
     {"saturated": 0.06}],
)  # fmt: skip
def test_a_skill_is_learned_when_every_number_is_within_its_limit(worse):
    assert PERFECT.meets(FLOOR)
    assert not dataclasses.replace(PERFECT, **worse).meets(FLOOR)


def test_results_are_logged_by_skill():
    scalars = as_scalars({"walk": PERFECT})
    assert scalars["Eval/score"] == 0.0
    assert scalars["Eval_walk/lifts"] == 2.0
    assert len(scalars) == 1 + len(dataclasses.fields(SkillResult))
