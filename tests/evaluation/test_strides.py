"""Swings and gait of hand-made walks."""

from __future__ import annotations

import numpy as np
import pytest

from kiras_rl.evaluation.strides import Swing, Walk, describe, swings

DT = 0.01  # s; a swing takes four steps


def foot(pattern):
    """Return the contacts of a foot: _ on the ground, ^ in the air."""
    return np.array([step == "_" for step in pattern])


@pytest.mark.parametrize(
    ("pattern", "expected"),
    [
        ("__^^^__", []),  # 30 ms: it chatters
        ("__^^^^__", [Swing(2, 6, True)]),
        ("^^^^^^__^^^^^_", [Swing(8, 13, True)]),  # nobody saw the first one lift
        ("__^^^^^", [Swing(2, 7, False)]),
        ("__^^^", []),
        ("_^^^^_^^^^^_", [Swing(1, 5, True), Swing(6, 11, True)]),
        ("____", []),
        ("^^^^^", []),
    ],
)
def test_a_swing_lasts_40_ms(pattern, expected):
    assert swings(foot(pattern), DT) == expected


def make_walk(patterns, height, velocity):
    """Return a walk of two joints whose feet rise 1 mm a step."""
    contact = np.stack([foot(pattern) for pattern in patterns], axis=1)
    steps, feet = contact.shape
    return Walk(
        dt=DT,
        height=np.array(height),
        pitch=np.full(steps, 0.2),
        velocity=np.full(steps, velocity),
        contact=contact,
        foot_height=np.tile(0.001 * np.arange(steps)[:, None], (1, feet)),
        power=np.full(steps, 11.0),
    )


def test_posture_and_gait_by_hand():
    high = make_walk(["_^^^^_____", "__________"], [0.21, 0.23] * 5, 0.2)
    low = make_walk(["_^^^^_^^^^", "__^^_^^^^^"], [0.17] * 10, 0.4)
    result = describe([high, low], height=0.2, pitch=0.3)
    assert result["height"] == pytest.approx(-0.005)  # means of 0.22 and 0.17
    assert result["height_error"] == pytest.approx(0.025)
    assert result["pitch"] == pytest.approx(-0.1) and result["pitch_error"] == pytest.approx(0.1)
    assert result["velocity"] == pytest.approx(0.3)
    assert result["lifts"] == pytest.approx([15.0, 5.0])  # 1 and 2, 0 and 1 in 0.1 s
    assert result["clearance"] == pytest.approx(0.004)  # of the two swings that landed
    assert result["duty"] == pytest.approx((16 / 20 + 5 / 20) / 2)
    assert result["power"] == pytest.approx(2 * 3 + 5 * 1)


def test_who_fell_before_has_nothing_to_count():
    walk = make_walk(["_^^^^_____"], [0.2] * 10, 0.2)
    none = make_walk([""], [], 0.2)
    assert describe([walk, none], 0.2, 0.2) == describe([walk], 0.2, 0.2)
    assert set(describe([none], 0.2, 0.2).values()) == {None}


def test_a_thinned_walk_holds_the_last_of_every_few_steps():
    walk = make_walk(["_^^^^^^^^^"], np.arange(10.0), 0.2).thinned(5)
    assert walk.height.tolist() == [4.0, 9.0]
    assert walk.contact[:, 0].tolist() == [True, False]  # stood in one of the first five
    assert walk.dt == pytest.approx(0.05) and walk.duration == pytest.approx(0.1)
