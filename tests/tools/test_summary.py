"""The table's numbers, against traces that can be counted by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.evaluation import flat
from kiras_rl.tools.driving.driver import Driver
from kiras_rl.tools.driving.script import Segment, record
from kiras_rl.tools.driving.summary import (
    AVERAGE,
    SETTLE,
    lifts_per_second,
    moving_average,
    seconds_in_segment,
    summarize,
)


def test_a_lift_is_a_foot_that_leaves_the_ground():
    contact = np.array([[1, 1], [0, 1], [0, 1], [1, 1], [0, 0], [0, 0], [1, 1], [1, 0]], bool)
    every = np.ones(8, bool)
    # two lifts each; eight samples at 4 Hz are two seconds
    assert lifts_per_second(contact, every, rate=4).tolist() == [1.0, 1.0]


def test_lifts_of_samples_that_do_not_count_are_left_out():
    contact = np.array([[1], [0], [0], [1], [0], [0]], bool)
    late = np.arange(6) >= 3
    assert lifts_per_second(contact, late, rate=3).tolist() == [1.0]


def test_quantities_are_those_of_the_evaluation_in_training():
    random = np.random.default_rng(0)
    signal, contact = random.normal(size=200), random.random((200, 4)) < 0.5
    torch_signal, torch_contact = torch.tensor(signal)[:, None], torch.tensor(contact)[:, None]
    averaged = flat.moving_average(torch_signal, 0.02)[:, 0]
    always = torch.ones(200, 1, dtype=torch.bool)
    lifts = flat.lifts_per_second(torch_contact, always, 0.02).amin(dim=-1)
    np.testing.assert_allclose(moving_average(signal, 50), averaged)
    assert lifts_per_second(contact, np.ones(200, bool), 50).min() == pytest.approx(lifts.item())
    assert (SETTLE, AVERAGE) == (flat.SETTLE, flat.AVERAGE)


@pytest.fixture(scope="module")
def trace_and_metadata(still_file):
    driver = Driver(OnboardPolicy(still_file))
    script = [Segment(2.0, "walk", (0.3, 0, 0)), Segment(2.0, "stilt", (0.1, 0, 0))]
    return record(driver, script), driver.metadata


def test_the_clock_of_a_segment_starts_at_zero(trace_and_metadata):
    seconds = seconds_in_segment(trace_and_metadata[0])
    np.testing.assert_allclose(seconds, np.tile(np.arange(100) / 50, 2))


def test_errors_are_those_of_the_second_half(trace_and_metadata):
    trace, metadata = trace_and_metadata
    walk, stilt = summarize(trace, metadata)
    assert (walk.skill, stilt.skill) == ("walk", "stilt")
    height, pitch = moving_average(trace.base_height, 50), moving_average(trace.pitch, 50)
    assert walk.height_error == pytest.approx(np.abs(height[50:100] - 0.2).mean())
    assert stilt.height_error == pytest.approx(np.abs(height[150:] - 0.3).mean())
    assert walk.pitch_error == pytest.approx(np.abs(pitch[50:100]).mean())
    assert (walk.command, stilt.command) == (pytest.approx(0.3), pytest.approx(0.1))
    assert walk.velocity_error == pytest.approx(np.abs(trace.lin_vel[50:100, 0] - 0.3).mean())
    assert walk.lifts == stilt.lifts == 0  # it stands still
    assert walk.falls == stilt.falls == 0
