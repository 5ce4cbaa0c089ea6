"""A policy file's description: complete and consistent, or an error that says what is not."""

from __future__ import annotations

import json

import pytest

from kiras_rl.deploy.metadata import PolicyError, PolicyMetadata


def test_json_there_and_back(make_metadata):
    metadata = make_metadata()
    assert PolicyMetadata.from_json(metadata.to_json()) == metadata


def test_sizes_follow_from_the_terms(make_metadata):
    """3 + 1 + 3 + 1 + 1 + 1 + 5 + 8 + 8 + 8 = 39 numbers a frame, 4 frames."""
    metadata = make_metadata()
    assert (metadata.num_joints, metadata.frame_size, metadata.history_size) == (8, 39, 156)


def test_a_key_of_a_later_version_is_left_out(make_metadata):
    metadata = make_metadata()
    assert PolicyMetadata.from_dict(metadata.to_dict() | {"mood": "fine"}) == metadata


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": 2}, "format 2 was given, and this version of kiras-rl reads format 1"),
        ({"kd": [0.1] * 7}, "kd holds 7 numbers for 8 joints"),
        ({"action_scale": [0.0] * 8}, "action_scale must be positive"),
        ({"kp": [float("nan")] * 8}, "kp cannot be read"),
        ({"skills": ["walk", "fly"]}, "no keyframe for the skills fly"),
        ({"skills": []}, "no skills"),
        ({"history_length": 0}, "history_length must be positive, not 0"),
        ({"observation": []}, "no observation terms"),
        ({"observation": [{"name": "wind", "size": 1, "scale": 1}]}, "unknown .* term 'wind'"),
        ({"observation": [{"name": "pitch", "size": 2, "scale": 1}]}, "has size 2, expected 1"),
        ({"observation": [{"name": "pitch"}]}, "observation cannot be read"),
        ({"command_range": {"lin_vel_x": [0, 1]}}, "command_range cannot be read"),
    ],
)
def test_what_does_not_fit_is_named(make_metadata, changes, message):
    with pytest.raises(PolicyError, match=message):
        make_metadata(**changes)


INF = float("inf")


def test_limits_may_be_missing_for_some_joints(make_metadata):
    limits = ((-1.0, 2.0), (-INF, 1.5), *[(-INF, INF)] * 6)
    metadata = make_metadata(joint_limits=limits, velocity_limit=[30.0] * 7 + [INF])
    assert metadata.joint_limits == limits
    assert metadata.velocity_limit == (30.0,) * 7 + (INF,)
    text = metadata.to_json()
    assert "Infinity" not in text  # no JSON
    assert PolicyMetadata.from_json(text) == metadata


def test_files_of_the_first_versions_have_no_limits(make_metadata):
    data = make_metadata().to_dict()
    del data["joint_limits"], data["velocity_limit"]
    metadata = PolicyMetadata.from_dict(data)
    assert metadata.joint_limits is None and metadata.velocity_limit is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"joint_limits": [[-1.0, 1.0]] * 7}, "joint_limits holds 7 entries for 8 joints"),
        ({"joint_limits": [[1.0, -1.0]] * 8}, r"joint_limits hold \(1.0, -1.0\): the lower"),
        ({"joint_limits": [1.0] * 8}, "joint_limits cannot be read"),
        ({"velocity_limit": [1.0]}, "velocity_limit holds 1 entries for 8 joints"),
    ],
)
def test_limits_that_do_not_fit_are_named(make_metadata, changes, message):
    with pytest.raises(PolicyError, match=message):
        make_metadata(**changes)


def test_a_file_of_before_has_no_profile(make_metadata):
    data = make_metadata().to_dict()
    del data["onboard"]
    assert PolicyMetadata.from_dict(data).onboard is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rate": 0.0}, r"onboard cannot be read \(ValueError\('rate is 0.0'\)\)"),
        ({"max_tilt": float("nan")}, "max_tilt is nan"),
        ({"max_power": None}, "onboard cannot be read"),
        ({"late_ticks": [1, 2]}, "onboard cannot be read"),
    ],
)
def test_a_profile_that_does_not_fit_is_named(make_metadata, changes, message):
    onboard = {**make_metadata().to_dict()["onboard"], **changes}
    with pytest.raises(PolicyError, match=message):
        make_metadata(onboard=onboard)


def test_a_profile_is_whole(make_metadata):
    onboard = make_metadata().to_dict()["onboard"]
    del onboard["slew"]
    with pytest.raises(PolicyError, match=r"onboard cannot be read \(KeyError\('slew'\)\)"):
        make_metadata(onboard=onboard)


def test_a_missing_value_is_named(make_metadata):
    data = make_metadata().to_dict()
    del data["kp"], data["version"]
    with pytest.raises(PolicyError, match="missing: kp, version"):
        PolicyMetadata.from_json(json.dumps(data))


@pytest.mark.parametrize("text", ["", "{", "[]", "7"])
def test_other_text_is_refused(text):
    with pytest.raises(PolicyError, match=r"not valid JSON|not a JSON object"):
        PolicyMetadata.from_json(text)
