"""WTW: its schedule and rewards by hand, what is estimated, and the clock on the robot."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from kiras_rl import interfaces as names
from kiras_rl.baselines import wtw
from kiras_rl.config import ConfigError
from kiras_rl.deploy.gaits import FREQUENCY, SWING_HEIGHT
from kiras_rl.deploy.terms import Reading, find_rebuild, path_of

PART = "learner.parts.adaptation"


def cdf(x):
    return 0.5 * (1.0 + math.erf(x / math.sqrt(2.0)))


def step_of(phase, **robot):
    """Return a step of two worlds at a phase of the clock; the second is told to stand."""
    terms = {
        "clock": torch.tensor([[phase, 3.0]]).expand(2, -1),
        "swing_height": torch.full((2, 1), 0.08),
    }
    keyframes = SimpleNamespace(
        height=torch.tensor([0.2, 0.3]),
        gravity_b=torch.tensor([[0.0, 0.0, -1.0], [0.5, 0.0, -math.sqrt(0.75)]]),
    )
    return SimpleNamespace(
        stands=torch.tensor([False, True]),
        moves=torch.tensor([True, False]),
        weight=20.0,
        task=SimpleNamespace(terms=terms, skill=torch.tensor([0, 1])),
        keyframes=keyframes,
        robot=SimpleNamespace(**robot),
    )


def test_diagonal_feet_turn_together():
    turns = wtw.foot_turns(torch.tensor([[0.25], [0.75]]))
    assert turns.tolist() == [[0.25, 0.75, 0.75, 0.25], [0.75, 0.25, 0.25, 0.75]]


def test_the_schedule_is_stance_then_swing_smoothed():
    turns = torch.tensor([[0.0, 0.25, 0.5, 0.75, 0.55, 1.0]])
    contact = wtw.desired_contact(turns)[0]
    assert contact[[1, 3]].tolist() == pytest.approx([1.0, 0.0], abs=1e-3)
    assert contact[[0, 2, 5]].tolist() == pytest.approx([0.5] * 3, abs=1e-4)
    assert contact[4].item() == pytest.approx(1.0 - cdf(0.05 / 0.07), abs=1e-5)


def test_force_in_swing_and_velocity_in_stance_cost():
    # FL and HR in the middle of their stance, FR and HL of their swing
    force = torch.tensor([[20.0, 2.0, 0.0, 0.0]]).expand(2, -1)
    found = wtw.contact_force(step_of(0.25, foot_force=force), scale=0.01)
    expected = (1.0 - math.exp(-((2.0 / 20.0) ** 2) / 0.01)) / 4
    assert found.tolist() == pytest.approx([expected, 0.0], abs=1e-3)
    velocity = torch.zeros(2, 4, 3)
    velocity[:, 0] = torch.tensor([1.0, 0.0, 2.0])
    velocity[:, 1] = 5.0  # in swing
    found = wtw.contact_velocity(step_of(0.25, foot_vel_w=velocity), scale=10.0)
    assert found.tolist() == pytest.approx([(1.0 - math.exp(-0.5)) / 4, 0.0], abs=2e-3)


def test_a_swing_has_its_height_in_the_middle():
    assert wtw.swing_arc(torch.tensor([0.25, 0.5, 0.625, 0.75, 0.9])).tolist() == pytest.approx(
        [0.0, 0.0, 0.5, 1.0, 0.4]
    )
    height = torch.tensor([[0.05, 0.06, 0.08, 0.0]]).expand(2, -1)
    found = wtw.swing_height(step_of(0.25, foot_height=height))
    assert found.tolist() == pytest.approx([0.02**2, 0.0], abs=1e-5)


def test_body_errors_are_from_the_skill_s_keyframe():
    robot = {
        "base_height": torch.tensor([0.25, 0.25]),
        "gravity_b": torch.tensor([[0.3, 0.4, -math.sqrt(0.75)], [0.5, 0.0, -math.sqrt(0.75)]]),
    }
    step = step_of(0.0, **robot)
    assert wtw.body_height(step).tolist() == pytest.approx([0.0025, 0.0025])
    assert wtw.body_orientation(step).tolist() == pytest.approx([0.25, 0.0])


@pytest.fixture
def module():
    """Return a module without hidden layers on two frames of one number, of one property."""
    network = wtw.AdaptationModule(1, 1, 1, [])
    with torch.no_grad():
        network.encoder[0].weight.zero_()
        network.encoder[0].weight[3, 1] = 2.0
        network.encoder[0].bias.copy_(torch.tensor([1.0, 0.0, 0.0, 5.0]))
    return network


def test_the_actor_is_told_velocity_properties_and_the_past(module):
    frames = module.frames({names.PROPRIO: torch.tensor([[4.0]]), names.HISTORY: torch.ones(1, 1)})
    assert module.context(frames).tolist() == [[1.0, 0.0, 0.0, 5.0 + 2.0 * 4.0, 1.0]]


def test_its_loss_is_the_squared_error_of_both(module):
    config = wtw.WtwConfig(["friction"], encoder_dims=[], relative_step=1.0, epochs=1)
    part = wtw.Adaptation(config, module, [0], "cpu")
    loss, errors = part._loss(
        frames=torch.tensor([[1.0, 4.0]]),
        velocity=torch.tensor([[1.0, 0.0, 3.0]]),
        properties=torch.tensor([[10.0]]),
    )
    assert errors.tolist() == pytest.approx([3.0, 9.0])
    assert loss.item() == pytest.approx(4 * 3.0 + 9.0)


def test_it_is_taught_friction_and_payload(make_runner):
    runner = make_runner("wtw", "run", "env.randomized_share=[[0,1]]")
    part, obs = runner.alg.parts["adaptation"], runner.env.get_observations()
    told = obs[names.CRITIC][:, part._columns]
    assert torch.equal(told, runner.env._physics * torch.tensor([1.0, 2.0]))
    assert ((told[:, 0] >= 0.5) & (told[:, 0] < 1.25)).all()
    assert ((told[:, 1] >= -1.0) & (told[:, 1] < 0.5)).all()
    assert (told.std(dim=0) > 0.05).all()
    rest = runner.env.keyframe_observations()[..., part._columns]
    assert (rest == rest[0, 0]).all() and rest[0, 0, 1] == 0.0


@pytest.mark.parametrize("time", [0.0, 0.1, 7.3])
def test_the_robot_s_clock_is_that_of_the_training(time):
    asked = {
        "clock": torch.tensor([[FREQUENCY * time % 1.0, FREQUENCY]]),
        "swing_height": torch.tensor([[SWING_HEIGHT]]),
    }
    view = SimpleNamespace(task=SimpleNamespace(terms=asked))
    for term in (wtw.clock_signal, wtw.behaviour):
        rebuild = find_rebuild(path_of(term.onboard))
        found = rebuild(replace(Reading.example(8, 5), time=time))
        np.testing.assert_allclose(found, term(view)[0], atol=1e-5)


def test_a_property_has_to_be_observed_by_the_critic():
    terms = ["env.observations.proprio.skill", "env.observations.critic.friction"]
    env = SimpleNamespace(name_term=lambda group, column: terms[column])
    assert wtw.find_columns(env, ["friction"], proprio=1, critic=2) == [1]
    with pytest.raises(ConfigError, match=r"no env\.observations\.critic\.mass is configured"):
        wtw.find_columns(env, ["mass"], proprio=1, critic=2)
    with pytest.raises(ConfigError, match="name at least one term"):
        wtw.find_columns(env, [], proprio=1, critic=2)


@pytest.mark.parametrize(
    ("override", "part"),
    [
        (f"{PART}.encoder_dims=[8,0]", f"{PART}.encoder_dims=[8, 0]: must be positive"),
        ("env.rewards.sigma=0", "env.rewards.sigma=0.0: must be positive"),
        ("env.commands.terms.swing_height.limits=3", "terms.swing_height: 3: give [low, high]"),
    ],
)
def test_a_mistake_is_one_line(make_runner, override, part):
    with pytest.raises(ConfigError) as caught:
        make_runner("wtw", "run", override)
    assert part in str(caught.value)
    assert "\n" not in str(caught.value)
