"""Ends of an episode by failure: from the library or from a user's file, each with its tag."""

from __future__ import annotations

import pytest
import torch

from kiras_rl import interfaces as names
from kiras_rl.config import ConfigError, config_from_dict, config_to_dict, load_config
from kiras_rl.phases import FINETUNING, phase_of
from kiras_rl.runner import shares_of_ends

WORLDS = 6
MINE = '''
"""Ends of my own."""

import torch


def jumping(step, height: float):
    """Return the worlds whose base is higher than `height` m."""
    return step.robot.base_height > height


def wrong(step):
    """Return heights, which are no worlds."""
    return step.robot.base_height


SIZE = 3
'''


@pytest.fixture(autouse=True)
def mine(tmp_path, monkeypatch):
    """Put a user's file where Python finds it."""
    (tmp_path / "my_ends.py").write_text(MINE)
    monkeypatch.syspath_prepend(tmp_path)


def term(name, **values):
    pairs = [f"function: 'my_ends:{name}'", *(f"{key}: {value}" for key, value in values.items())]
    return f"env.terminations.terms.high={{{', '.join(pairs)}}}"


def lift(env, worlds, height):
    """Put some worlds into the air, upright and at rest."""
    qpos, mask = env.sim.qpos.clone(), torch.zeros(env.num_envs, dtype=torch.bool)
    mask[worlds] = True
    qpos[:, 2] = height
    env.sim.write_state(mask, qpos, torch.zeros_like(env.sim.qvel), qpos[:, 7:])


def test_a_term_of_the_user_ends_episodes_and_has_its_tag(build_env, nominal):
    env = build_env(*nominal, term("jumping", height=0.6), num_envs=WORLDS)
    env.reset()
    lift(env, [1, 4], 1.0)
    _, _, dones, extras = env.step(torch.zeros(WORLDS, env.num_actions))
    assert dones.nonzero().flatten().tolist() == [1, 4]
    assert not extras[names.EXTRA_TIME_OUTS].any()
    log = {key: value.item() for key, value in extras["log"].items() if key.startswith("Episode")}
    by = names.ENDED_BY
    assert log == {
        names.FALLS: 2, names.TIME_OUTS: 0, f"{by}base_contact": 0, f"{by}tilted": 0, f"{by}high": 2
    }  # fmt: skip


def test_without_reasons_only_broken_physics_is_a_fall(build_env):
    none = [f"env.terminations.terms.{name}=null" for name in ("base_contact", "tilted")]
    env = build_env(*none, num_envs=WORLDS)
    qpos = env.sim.qpos.clone()
    qpos[:, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0])  # legs up
    everywhere = torch.ones(WORLDS, dtype=torch.bool)
    env.sim.write_state(everywhere, qpos, torch.zeros_like(env.sim.qvel), qpos[:, 7:])
    env.sim.write_velocity(torch.arange(WORLDS) == 2, torch.full_like(env.sim.qvel, torch.nan))
    _, _, dones, extras = env.step(torch.zeros(WORLDS, env.num_actions))
    assert dones.nonzero().flatten().tolist() == [2]
    assert extras["log"][names.FALLS] == 1


def test_counts_become_shares_of_all_ends():
    counts = {names.FALLS: 3.0, names.TIME_OUTS: 5.0, f"{names.ENDED_BY}tilted": 2.0}
    assert shares_of_ends(counts) == {f"{names.ENDED_BY}tilted": 0.25}
    assert shares_of_ends({f"{names.ENDED_BY}tilted": 0.0}) == {f"{names.ENDED_BY}tilted": 0.0}


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (term("wrong"), r"terms.high: the term returns torch.float32 of shape \(6\), .* bool of"),
        (term("jumping"), "terms.high: missing a required argument: 'height'"),
        (term("jumping", height="up"), "terms.high.height='up': must be a number"),
        (term("falling"), "terms.high.function=my_ends:falling: give a function as package.module"),
        (term("SIZE"), "package.module:function; this is a int"),
        ("env.terminations.terms.high={function: my_ends}", "give a function as package.module"),
        ("env.terminations.terms.tilt={angle: 3}", "no term 'tilt': did you mean 'tilted'?"),
        ("env.terminations.terms.tilted.most=3", "unknown parameter 'most'; it takes angle"),
        ("env.terminations.terms.tilted=3", r"tilted: give its parameters, as in tilted: \{\}"),
        ("env.terminations.terms.tilted.angle=200", "above 0, at most 180"),
        ("env.terminations.max_tilt=3", "it is 'env.terminations.terms.tilted.angle' now"),
    ],
)
def test_what_cannot_be_a_reason_is_one_clear_line(override, message, build_env):
    with pytest.raises(ConfigError, match=message) as caught:
        build_env(override, num_envs=WORLDS)
    assert "\n" not in str(caught.value)


def test_what_earlier_versions_saved_keeps_its_limits():
    config = load_config("solo8", ["env.terminations.terms.tilted.angle=40"])
    values = config_to_dict(config)
    values["env"]["terminations"] |= {"max_tilt": 40.0, "base_contact_force": 1.0}
    del values["env"]["terminations"]["terms"]
    values["finetuning"]["env"]["terminations"] = {"max_tilt": 70.0}
    read = config_from_dict(values)
    assert read.env == config.env
    terms = phase_of(read, FINETUNING).config.env.terminations.terms
    assert terms == {"tilted": {"angle": 70.0}, "base_contact": {"force": 1.0}}
