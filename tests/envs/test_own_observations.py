"""Observations from a user's file: in every group, on the robot, or refused in one line."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch

from kiras_rl import interfaces as names
from kiras_rl.config import ConfigError
from kiras_rl.deploy.metadata import FORMAT, PolicyMetadata
from kiras_rl.deploy.policy import OnboardPolicy, PolicyError
from kiras_rl.export import export_policy

WORLDS = 4
MINE = '''
"""Observations of my own."""

import numpy as np

from kiras_rl.deploy.terms import observed


def clock_onboard(reading):
    """Return sine and cosine of a clock of 0.5 Hz, (2,)."""
    return np.array([np.sin(np.pi * reading.time), np.cos(np.pi * reading.time)])


@observed(unit="1", onboard=clock_onboard)
def clock(view):
    """Return what a clock shows in the first second, (N, 2)."""
    return view.robot.base_pos_w[:, :2] * 0.0


@observed(unit="rad", onboard=lambda reading: reading.joint_pos[:2])
def hidden(view):
    """Return two angles, (N, 2), rad, with a twin that has no name."""
    return view.sensed.joint_pos[:, :2]


def heights(view, least: float):
    """Return heights of the feet above `least` m, (N, F), m."""
    return view.robot.foot_height - least
'''


@pytest.fixture(autouse=True)
def mine(tmp_path, monkeypatch):
    """Put a user's file where Python finds it."""
    (tmp_path / "my_views.py").write_text(MINE)
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("my_views", None)


def entry(group, function, name="mine", **values):
    pairs = [f"function: 'my_views:{function}'", *(f"{k}: {v}" for k, v in values.items())]
    return f"env.observations.{group}.{name}={{{', '.join(pairs)}}}"


def metadata(env):
    return PolicyMetadata.from_dict(
        {"format": FORMAT, "version": "0", "provenance": {}, **env.describe()}
    )


@pytest.mark.parametrize("group", ["critic", "imitation"])
def test_every_group_takes_functions_with_parameters(build_env, group):
    env = build_env(entry(group, "heights", scale=2.0, least=0.01), num_envs=WORLDS)
    obs = env.step(torch.randn(WORLDS, 8))[0]
    seen = obs[names.CRITIC if group == "critic" else names.IMITATION]
    torch.testing.assert_close(seen[:, -4:], 2.0 * (env.robot.foot_height - 0.01))
    metadata(env)  # what stays in training needs no twin


def test_a_twin_of_the_user_runs_on_the_robot(build_env, make_policy, tmp_path):
    meta = metadata(build_env(entry("proprio", "clock", scale=3.0), num_envs=WORLDS))
    assert meta.observation[-1].onboard == "my_views:clock_onboard"
    export_policy(make_policy(meta), meta, tmp_path / "p.onnx")
    policy = OnboardPolicy(tmp_path / "p.onnx")
    assert policy.metadata == meta
    rest = np.zeros(8)
    policy.reset(rest)
    for step in range(30):
        policy.step(rest, rest, (1, 0, 0, 0), rest[:3], rest[:3], "walk")
        angle = np.pi * step / 50
        np.testing.assert_allclose(
            policy.frame[-2:], 3 * np.array([np.sin(angle), np.cos(angle)]), atol=1e-6
        )


def test_where_the_file_is_missing_the_policy_is_refused_in_one_line(
    build_env, make_policy, tmp_path, monkeypatch
):
    meta = metadata(build_env(entry("proprio", "clock"), num_envs=WORLDS))
    export_policy(make_policy(meta), meta, tmp_path / "p.onnx")
    monkeypatch.setattr(sys, "path", [x for x in sys.path if x != str(tmp_path)])
    del sys.modules["my_views"]
    with pytest.raises(PolicyError, match="my_views:clock_onboard cannot be imported") as caught:
        OnboardPolicy(tmp_path / "p.onnx")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("function", "name", "values"),
    [
        ("heights", "heights", {"least": 0.0}),
        ("heights", "pitch", {"least": 0.0}),  # no twin, in spite of the name
        ("hidden", "hidden", {}),
    ],
)
def test_what_nothing_rebuilds_is_refused_in_one_line(build_env, function, name, values):
    env = build_env(entry("proprio", function, name, **values), num_envs=WORLDS)
    with pytest.raises(PolicyError, match=f"unknown observation term '{name}'; known: ") as caught:
        metadata(env)
    assert str(caught.value).endswith("one of your own says what rebuilds it: onboard")
    assert "\n" not in str(caught.value)


def test_a_term_of_the_library_under_another_name_has_its_twin(build_env):
    override = "env.observations.proprio.lean={function: 'kiras_rl.envs.observations:pitch'}"
    meta = metadata(build_env(override, num_envs=WORLDS))
    assert (meta.observation[-1].name, meta.observation[-1].onboard) == ("lean", "pitch")


def test_what_a_term_is_given_but_does_not_take_is_named(build_env):
    with pytest.raises(ConfigError, match=r"critic\.mine: unknown key 'most'; it takes scale"):
        build_env(entry("critic", "heights", most=1.0), num_envs=WORLDS)
