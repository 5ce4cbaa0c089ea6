"""A drive by hand, without a screen: commands and their limits, skills, falls, time, policies."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from kiras_rl.config import config_to_dict, load_config
from kiras_rl.deploy.policy import OnboardPolicy, PolicyError
from kiras_rl.export import export_policy
from kiras_rl.tools.driving.ground import FLAT, Tile
from kiras_rl.tools.driving.viewer import bindings
from kiras_rl.tools.driving.viewer.cockpit import FALL_SECONDS, FORWARD, LEFT, SPEEDS, YAW, Cockpit

DT = 0.02


@pytest.fixture
def cockpit(still_file):
    return Cockpit(OnboardPolicy(still_file))


def run(cockpit, seconds):
    for _ in range(round(seconds / DT)):
        sample = cockpit.advance()
    return sample


def test_targets_stay_within_what_the_policy_was_trained_for(cockpit):
    for axis, (low, high) in enumerate([(-0.3, 0.6), (0.0, 0.0), (-0.6, 0.6)]):
        cockpit.set_target(axis, 9.0)
        assert cockpit.target[axis] == high
        cockpit.set_target(axis, -9.0)
        assert cockpit.target[axis] == low


def test_a_stick_spans_the_limits_on_both_sides_of_zero(cockpit):
    shares = {1.0: 0.6, 0.5: 0.3, 0.0: 0.0, -0.5: -0.15, -1.0: -0.3}
    for share, velocity in shares.items():
        cockpit.set_share(FORWARD, share)
        assert cockpit.target[FORWARD] == pytest.approx(velocity)


def test_a_held_key_changes_the_velocity_until_its_limit(cockpit):
    for _ in range(round(0.5 / DT)):
        cockpit.hold(FORWARD, 1.0, seconds=0.1)
        cockpit.advance()
    assert 0.2 < cockpit.target[FORWARD] < 0.3  # half a second at 0.5 m/s in a second
    for _ in range(round(2 / DT)):
        cockpit.hold(FORWARD, 1.0, seconds=0.1)
        cockpit.advance()
    assert cockpit.target[FORWARD] == 0.6


def test_let_go_the_speed_stays_and_the_steering_springs_back(cockpit):
    for axis in (FORWARD, YAW):
        cockpit.hold(axis, 1.0, seconds=0.3)
    run(cockpit, 0.2)
    speed, turn = cockpit.target[FORWARD], cockpit.target[YAW]
    assert speed > 0.05
    assert turn > 0.1
    run(cockpit, 0.4)
    assert cockpit.target[FORWARD] >= speed
    assert cockpit.target[YAW] == 0.0


def test_the_policy_is_given_no_jumps(cockpit):
    cockpit.set_target(FORWARD, 0.6)
    commands = [cockpit.advance().command[FORWARD] for _ in range(50)]
    assert np.diff(commands).max() < 0.05
    assert commands[-1] == pytest.approx(0.6)


def test_stop_asks_for_standing_still(cockpit):
    cockpit.set_target(FORWARD, 0.5)
    cockpit.hold(YAW, 1.0, seconds=5.0)
    run(cockpit, 0.5)
    cockpit.stop()
    run(cockpit, 1.0)
    np.testing.assert_allclose(cockpit.command, 0.0)


def test_a_skill_is_chosen_by_name_or_key(cockpit):
    cockpit.choose_skill("stilt")
    assert cockpit.advance().skill == 2
    assert bindings.press(cockpit, "4")
    assert cockpit.advance().skill == 3
    assert not bindings.press(cockpit, "9")  # it has five
    with pytest.raises(PolicyError, match="unknown skill 'fly'"):
        cockpit.choose_skill("fly")


def test_what_is_posted_waits_for_the_next_step(cockpit):
    cockpit.post(cockpit.choose_skill, "crawl")
    assert cockpit.skill == 0
    cockpit.advance()
    assert cockpit.skill == 1


def test_a_key_for_a_skill_that_is_not_there_is_no_end(cockpit):
    cockpit.post(cockpit.choose_skill, 7)
    assert cockpit.advance() is not None
    assert "unknown skill '7'" in cockpit.notice


def test_a_push_is_felt_and_its_strength_is_as_set(cockpit):
    run(cockpit, 0.5)
    cockpit.push_speed = 0.8
    before = cockpit.driver.data.qvel[:3].copy()
    cockpit.push()
    added = cockpit.driver.data.qvel[:3] - before
    assert np.hypot(*added[:2]) == pytest.approx(0.8)
    assert added[2] == 0.0


def test_pause_stops_time_and_one_step_can_be_taken(cockpit):
    run(cockpit, 0.1)
    cockpit.toggle_pause()
    qpos = cockpit.driver.data.qpos.copy()
    assert cockpit.advance() is None
    np.testing.assert_array_equal(cockpit.driver.data.qpos, qpos)
    cockpit.single_step()
    assert cockpit.advance().time == pytest.approx(0.12)
    assert cockpit.advance() is None
    cockpit.toggle_pause()
    assert cockpit.advance() is not None


def test_what_is_pressed_while_paused_is_done(cockpit):
    cockpit.toggle_pause()
    bindings.press(cockpit, "2")
    cockpit.advance()
    assert cockpit.skill == 1
    bindings.press(cockpit, "T")
    assert cockpit.advance() is not None


def test_slow_motion_goes_through_its_speeds(cockpit):
    seen = []
    for _ in SPEEDS:
        seen.append(cockpit.speed)
        cockpit.next_speed()
    assert tuple(seen) == SPEEDS
    assert cockpit.speed == 1.0


def test_slow_motion_can_be_watched_between_control_steps(cockpit):
    heights = []
    cockpit.advance(after_substep=lambda: heights.append(cockpit.driver.data.qpos[2]))
    assert len(set(heights)) == cockpit.driver.substeps == 4


def test_reset_stands_in_the_posture_of_the_chosen_skill(cockpit):
    cockpit.set_target(FORWARD, 0.5)
    run(cockpit, 0.5)
    cockpit.choose_skill("stilt")
    cockpit.reset()
    assert cockpit.driver.data.qpos[2] == pytest.approx(0.3, abs=0.01)
    np.testing.assert_array_equal(cockpit.command, 0.0)


@pytest.fixture
def collapsing(make_metadata, make_policy, tmp_path):
    """Legs stretched backward carry nothing."""
    metadata = make_metadata()
    networks = make_policy(metadata, gain=0.0)
    networks.actor[-1].bias.data[:] = torch.tensor([1.54, 3.2] * 4)  # (1.57, 0) rad
    export_policy(networks, metadata, tmp_path / "collapsing.onnx")
    return OnboardPolicy(tmp_path / "collapsing.onnx")


def test_a_fallen_robot_lies_a_moment_and_is_put_back_into_its_posture(collapsing):
    cockpit = Cockpit(collapsing)
    cockpit.choose_skill("stilt")
    cockpit.reset()
    down = 0
    while cockpit.falls == 0:
        sample = cockpit.advance()
        down += sample.fallen
        assert sample.time < 5.0
    assert down * DT == pytest.approx(FALL_SECONDS, abs=0.1)
    assert cockpit.driver.data.qpos[2] == pytest.approx(0.3, abs=0.01)
    assert "stilt" in cockpit.notice


def test_another_policy_for_the_same_robot_goes_on_in_full_stride(cockpit, exported):
    cockpit.choose_skill("crawl")
    cockpit.set_target(FORWARD, 0.3)
    run(cockpit, 0.5)
    qpos, qvel = cockpit.driver.data.qpos.copy(), cockpit.driver.data.qvel.copy()
    cockpit.load(OnboardPolicy(exported[2]), "another")
    np.testing.assert_array_equal(cockpit.driver.data.qpos, qpos)
    np.testing.assert_array_equal(cockpit.driver.data.qvel, qvel)
    assert cockpit.title == "another"
    sample = cockpit.advance()
    assert (sample.skill, sample.command[FORWARD]) == (1, pytest.approx(0.3))
    assert sample.time == pytest.approx(0.52)


def test_a_policy_with_other_skills_starts_anew(cockpit, make_metadata, make_policy, tmp_path):
    skills = make_metadata().skills[:2]
    terms = [vars(term) for term in make_metadata().observation]
    terms = [term | {"size": 2} if term["name"] == "skill" else term for term in terms]
    metadata = make_metadata(skills=skills, observation=terms)
    export_policy(make_policy(metadata), metadata, tmp_path / "two.onnx")
    cockpit.choose_skill("pitch_up")
    cockpit.set_target(LEFT, 0.3)
    cockpit.load(OnboardPolicy(tmp_path / "two.onnx"), "two")
    assert (cockpit.skills, cockpit.skill) == (skills, 0)
    assert cockpit.advance().skill == 0


def test_telemetry_keeps_the_last_seconds_oldest_first(cockpit):
    cockpit.choose_skill("crawl")
    run(cockpit, 9.0)
    kept = cockpit.telemetry.view()
    assert len(kept["time"]) == 8.0 / DT
    np.testing.assert_allclose(np.diff(kept["time"]), DT)
    assert kept["time"][-1] == pytest.approx(9.0)
    assert set(kept["target_height"]) == {0.12}


def test_only_a_policy_with_an_estimator_has_an_estimate(
    cockpit, make_metadata, make_policy, tmp_path
):
    run(cockpit, 0.1)
    assert np.isfinite(cockpit.telemetry.view()["estimate_x"]).all()
    metadata = make_metadata()
    export_policy(make_policy(metadata, gain=0.0, estimator=False), metadata, tmp_path / "b.onnx")
    without = Cockpit(OnboardPolicy(tmp_path / "b.onnx"))
    run(without, 0.1)
    assert np.isnan(without.telemetry.view()["estimate_x"]).all()


def press(cockpit, keys):
    for key in keys:
        assert bindings.press(cockpit, key)
    cockpit.advance()


def test_keys_choose_the_ground(cockpit):
    press(cockpit, "F")
    assert cockpit.tile == Tile("slopes", 0, 0)
    press(cockpit, "LLVK")
    assert cockpit.tile == Tile("slopes", 1, 1)
    press(cockpit, "K" * 3 + "V" * 3)
    assert cockpit.tile == Tile("slopes", 0, 0)
    press(cockpit, "L" * 12)
    assert cockpit.tile == Tile("slopes", 9, 0)
    press(cockpit, "F" * 9)  # through all types
    assert cockpit.tile.is_flat


def test_flat_ground_has_no_levels_and_says_so(cockpit):
    press(cockpit, "L")
    assert cockpit.tile == FLAT
    assert "neither levels nor variants" in cockpit.notice


def test_on_another_ground_it_stands_in_the_chosen_skill(cockpit):
    cockpit.choose_skill("stilt")
    cockpit.set_target(FORWARD, 0.3)
    run(cockpit, 0.5)
    cockpit.choose_tile(kind="stairs_up", level=4)
    assert cockpit.skill == 2
    assert not cockpit.target.any()
    height = cockpit.driver.metadata.keyframes["stilt"].base_height
    assert cockpit.advance().base_height == pytest.approx(height, abs=0.02)


def test_at_the_end_of_a_tile_it_goes_on_in_the_middle(cockpit):
    cockpit.choose_tile(kind="bars")
    cockpit.set_target(FORWARD, 0.3)
    cockpit.driver.data.qpos[0] = 3.8
    assert cockpit.advance().crossed
    assert (cockpit.crossings, cockpit.falls) == (1, 0)
    assert cockpit.driver.data.qpos[0] == 0
    assert cockpit.target[FORWARD] == 0.3


def test_another_policy_takes_over_on_the_same_ground(cockpit, exported):
    cockpit.choose_tile(kind="stairs_up", level=4, variant=1)
    run(cockpit, 0.2)
    qpos = cockpit.driver.data.qpos.copy()
    cockpit.load(OnboardPolicy(exported[2]), "another")
    assert cockpit.tile == Tile("stairs_up", 4, 1)
    np.testing.assert_array_equal(cockpit.driver.data.qpos, qpos)


def test_a_policy_of_another_terrain_stands_on_its_own(
    cockpit, make_metadata, make_policy, tmp_path
):
    config = load_config("base", ["finetuning.env.terrain.levels=3"])
    metadata = make_metadata(provenance={"config": config_to_dict(config)})
    export_policy(make_policy(metadata, gain=0.0), metadata, tmp_path / "a.onnx")
    cockpit.choose_tile(kind="stairs_up", level=4)
    cockpit.load(OnboardPolicy(tmp_path / "a.onnx"), "three levels")
    assert cockpit.tile == Tile("stairs_up", 2, 0)
    assert cockpit.advance().base_height == pytest.approx(0.2, abs=0.05)
