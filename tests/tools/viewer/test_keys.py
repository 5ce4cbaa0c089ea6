"""No key of the page is lost, however slow its pictures are."""

from __future__ import annotations

import pytest

from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.tools.driving.viewer.cockpit import FORWARD, YAW, Cockpit
from kiras_rl.tools.driving.viewer.keys import Keys
from kiras_rl.tools.driving.viewer.view import View

STEPS = 50  # a second


@pytest.fixture
def cockpit(still_file):
    return Cockpit(OnboardPolicy(still_file))


@pytest.fixture
def view():
    return View()


@pytest.fixture
def keys(cockpit, view):
    return Keys(cockpit, view)


def run(cockpit, seconds):
    for _ in range(round(seconds * STEPS)):
        cockpit.advance()


def test_a_key_that_was_pressed_and_let_go_between_two_pictures_acts(cockpit, keys):
    keys.press("3", at=1.00, now=5.0)
    keys.release("3", at=1.01, now=5.0)
    cockpit.advance()
    assert cockpit.skill == 2


def test_keys_act_in_their_order_and_each_of_them(cockpit, keys):
    for name in ("3", "P", "P", "2"):
        keys.press(name, at=0.0, now=0.0)
    cockpit.advance()
    assert (cockpit.skill, cockpit.pushes) == (1, 2)


def test_a_held_key_acts_until_it_is_let_go(cockpit, keys):
    keys.press("W", at=0.0, now=0.0)
    run(cockpit, 0.6)
    assert cockpit.target[FORWARD] == pytest.approx(0.3)  # 0.5 m/s in a second
    keys.release("W", at=0.6, now=0.6)
    run(cockpit, 0.6)
    assert cockpit.target[FORWARD] == pytest.approx(0.3)


def test_how_long_a_key_was_held_counts_even_if_both_ends_arrive_at_once(cockpit, keys):
    keys.press("W", at=2.0, now=7.0)
    keys.release("W", at=2.4, now=7.0)
    run(cockpit, 1.0)
    assert cockpit.target[FORWARD] == pytest.approx(0.2, abs=0.011)  # to a step


def test_steering_springs_back_when_its_key_is_let_go(cockpit, keys):
    keys.press("A", at=0.0, now=0.0)
    run(cockpit, 0.2)
    assert cockpit.target[YAW] > 0.2
    keys.release("A", at=0.2, now=0.2)
    run(cockpit, 0.1)
    assert cockpit.target[YAW] == 0.0


def test_of_two_keys_of_an_axis_the_one_that_is_still_held_acts_again(cockpit, keys):
    keys.press("A", at=0.0, now=0.0)
    keys.press("D", at=0.0, now=0.0)
    run(cockpit, 0.1)
    assert cockpit.target[YAW] < 0.0
    keys.release("D", at=0.1, now=0.1)
    run(cockpit, 0.4)
    assert cockpit.target[YAW] > 0.2


def test_a_page_that_goes_away_lets_go_of_all_its_keys(cockpit, keys):
    keys.press("A", at=0.0, now=0.0)
    run(cockpit, 0.2)
    keys.release_all()
    run(cockpit, 0.1)
    assert cockpit.target[YAW] == 0.0


def test_what_is_typed_into_a_field_drives_nothing(cockpit, keys, view):
    view.typing = True
    keys.press("3", at=0.0, now=0.0)
    keys.press("W", at=0.0, now=0.0)
    run(cockpit, 0.1)
    assert cockpit.skill == 0 and not cockpit.target.any()


def test_keys_of_the_view(keys, view):
    keys.press("C", at=0.0, now=0.0)
    assert not view.follow
    before = view.ghost
    keys.press("G", at=0.0, now=0.0)
    assert view.ghost != before
