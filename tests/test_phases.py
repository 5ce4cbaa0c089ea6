"""The two phases of a run: what each makes of its configuration."""

from __future__ import annotations

import pytest

from kiras_rl.config import ConfigError, config_to_dict, load_config
from kiras_rl.phases import (
    FINETUNING,
    SKILL_LEARNING,
    phase_of,
    plan,
    total_iterations,
)


def changed(one, other, prefix=""):
    """List the dotted keys in which two nested dictionaries differ."""
    keys = []
    for key in one.keys() | other.keys():
        a, b = one.get(key), other.get(key)
        if isinstance(a, dict) and isinstance(b, dict):
            keys += changed(a, b, f"{prefix}{key}.")
        elif a != b:
            keys.append(prefix + key)
    return sorted(keys)


def test_the_paper_s_phases_are_the_default():
    config = load_config("solo8")
    flat, rough = plan(config)
    assert (flat.name, flat.first, flat.last, flat.retention) == (SKILL_LEARNING, 0, 6000, None)
    assert (rough.name, rough.first, rough.last) == (FINETUNING, 6000, 36000)
    assert rough.retention == config.finetuning.retention
    assert flat.run is rough.run is config
    assert (config.num_envs, config.iterations) == (4096, 6000)
    assert total_iterations(config) == 36000


def test_skill_learning_is_the_run_without_finetuning():
    config = load_config("solo8")
    alone = phase_of(config, SKILL_LEARNING).config
    assert changed(config_to_dict(config), config_to_dict(alone)) == ["finetuning"]
    assert alone.env.terrain is None


def test_finetuning_has_its_changes_and_no_imitation():
    overrides = ["finetuning.env.terrain.scale=1.5", "finetuning.sim.threads=7"]
    alone = phase_of(load_config("solo8", overrides), FINETUNING).config
    assert alone.learner.imitation is None
    assert alone.learner.multi_critic is None
    assert alone.finetuning is None
    assert alone.sim.threads == 7
    assert alone.env.terrain.scale == 1.5
    assert list(alone.env.terrain.types) == [
        "flat",
        "slopes",
        "bars",
        "footholds",
        "stairs_up",
        "stairs_down",
        "pits",
        "plates",
        "ramps",
        "rough",
    ]


def test_the_paper_s_rewards_hold_in_both_phases():
    paper = load_config("paper")
    flat, rough = (phase_of(paper, phase).config for phase in (SKILL_LEARNING, FINETUNING))
    for rewards in (flat.env.rewards, rough.env.rewards):
        rewards.terms = {name: values for name, values in rewards.terms.items() if values}
    assert rough.env.rewards == flat.env.rewards
    assert paper.finetuning.retention.flat_loss_weight == 0


def test_a_run_may_leave_finetuning_out():
    config = load_config("solo8_quick")
    assert [phase.name for phase in plan(config)] == [SKILL_LEARNING]
    with pytest.raises(ConfigError, match="finetuning=null: this run has no phase"):
        phase_of(config, FINETUNING)
    assert total_iterations(config) == config.iterations


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("env.terrrain.scale=1", "unknown key 'env.terrrain'; did you mean 'env.terrain'?"),
        ("env.terrain.scale=big", "env.terrain.scale: Value 'big' of type 'str'"),
        ("sim.substeps=0", "finetuning: sim.substeps=0: must be positive"),
    ],
)
def test_a_change_that_cannot_be_is_one_clear_line(override, message):
    config = load_config("solo8", [f"finetuning.{override}"])
    with pytest.raises(ConfigError) as caught:
        phase_of(config, FINETUNING)
    assert message in str(caught.value)
    assert str(caught.value).startswith("finetuning")
    assert "\n" not in str(caught.value)
