"""Randomizations from the library's functions or from a user's file, beside those of the table."""

from __future__ import annotations

import pytest
import torch

from kiras_rl.config import ConfigError

MINE = '''
"""Randomizations of my own."""

import torch

from kiras_rl.envs.randomization import VELOCITY, randomizing
from kiras_rl.envs.randomness import JOINTS


@randomizing("actuator_gainprm", numbers=1)
def spring(draw, factor):
    """Scale the stiffness of all joints."""
    values = draw.fields["actuator_gainprm"].clone()
    values[..., 4].mul_(draw.between(factor))
    return {"actuator_gainprm": values}


@randomizing(VELOCITY, numbers=2)
def hop(draw, speed: float, interval: float):
    """Throw bases up now and then."""
    qvel = draw.fields[VELOCITY].clone()
    hit = draw.uniform[:, 0] < draw.dt / interval
    qvel[:, 2] = torch.where(hit, qvel[:, 2] + speed, qvel[:, 2])
    return {VELOCITY: qvel}


@randomizing("opt_gravity", numbers=1)
def unknown(draw):
    """Write what there is not."""
    return {}


@randomizing("dof_armature", numbers=JOINTS)
def narrow(draw):
    """Return a wrong shape."""
    return {"dof_armature": draw.uniform}


def unmarked(draw):
    """Say nothing."""
    return {}
'''
WORLDS = 6


@pytest.fixture(autouse=True)
def mine(tmp_path, monkeypatch):
    """Put a user's file where Python finds it."""
    (tmp_path / "my_draws.py").write_text(MINE)
    monkeypatch.syspath_prepend(tmp_path)


def terms(**entries):
    """Return the override that configures terms, as YAML."""
    inner = ", ".join(f"{name}: {entry}" for name, entry in entries.items())
    return f"env.randomization.terms={{{inner}}}"


def mine_of(name, **values):
    pairs = [f"function: 'my_draws:{name}'", *(f"{k}: {v}" for k, v in values.items())]
    return f"{{{', '.join(pairs)}}}"


def field(env, name):
    return env.sim.state_dict()[f"field/{name}"].float()


@pytest.mark.parametrize("backend", ["native", "warp"])
def test_a_field_that_nothing_else_writes_is_drawn_for_every_world(build_env, nominal, backend):
    override = terms(armature="{factor: [2.0, 4.0]}")
    env = build_env(*nominal, override, f"sim.backend={backend}", num_envs=WORLDS)
    original = torch.tensor(env.sim.model.dof_armature).float()
    drawn = field(env, "dof_armature")
    assert torch.equal(drawn[:, :6], original[:6].expand(WORLDS, 6))
    factor = drawn[:, 6:] / original[6:]
    assert (factor >= 2.0 - 1e-5).all() and (factor < 4.0 + 1e-5).all()
    assert len(factor.unique()) == WORLDS * 8
    env.reset()
    assert (field(env, "dof_armature")[:, 6:] != drawn[:, 6:]).all()


def test_terms_go_on_from_what_the_table_wrote(build_env, nominal):
    kp = "env.randomization.kp_factor=[2.0,2.0]"
    env = build_env(*nominal, kp, terms(spring=mine_of("spring", factor="[3.0, 3.0]")))
    torch.testing.assert_close(field(env, "actuator_gainprm")[..., 4], torch.full((8, 8), 6 * 5.0))
    torch.testing.assert_close(field(env, "actuator_gainprm")[..., 6], torch.full((8, 8), 0.1))


def test_episodes_that_are_nominal_have_no_term(build_env, nominal):
    share = "env.randomized_share=[[0,0],[1,0.5]]"
    override = terms(spring=mine_of("spring", factor="[3.0, 4.0]"))
    env = build_env(*nominal, share, override, num_envs=200)
    plain = field(env, "actuator_gainprm")[:, 0, 4] == 5.0
    assert plain.float().mean().item() == pytest.approx(0.5, abs=0.11)


def test_a_term_may_change_velocities_in_any_step(build_env, nominal):
    often = terms(hop=mine_of("hop", speed=2.0, interval=0.02))
    env = build_env(*nominal, often, num_envs=WORLDS)
    env.reset()
    env.step(torch.zeros(WORLDS, 8))
    rises = env.sim.qvel[:, 2] - env.measure().lin_vel_h[:, 2]
    torch.testing.assert_close(rises, torch.full((WORLDS,), 2.0))
    never = terms(hop=mine_of("hop", speed=2.0, interval=1e9))
    env = build_env(*nominal, never, num_envs=WORLDS)
    env.reset()
    env.step(torch.zeros(WORLDS, 8))
    assert torch.equal(env.sim.qvel[:, 2], env.measure().lin_vel_h[:, 2])


def test_a_resumed_environment_goes_on_exactly(build_env):
    override = terms(armature="{factor: [0.5, 4.0]}", hop=mine_of("hop", speed=1.0, interval=0.1))
    first = build_env(override, num_envs=WORLDS)
    second = build_env(override, "seed=9", num_envs=WORLDS)
    actions = [torch.randn(WORLDS, 8) for _ in range(20)]
    for action in actions[:10]:
        first.step(action)
    second.load_state_dict(first.state_dict())
    assert torch.equal(field(first, "dof_armature"), field(second, "dof_armature"))
    for action in actions[10:]:
        assert torch.equal(first.step(action)[0]["critic"], second.step(action)[0]["critic"])


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (terms(armatur="{factor: [1, 2]}"), "no term 'armatur': did you mean 'armature'?"),
        (terms(armature="{factor: [2, 1]}"), "terms.armature: [2, 1]: give [low, high], the lower"),
        (terms(armature="{factor: 2}"), "terms.armature: 2: give [low, high]"),
        (terms(armature="{}"), "terms.armature: missing a required argument: 'factor'"),
        (terms(x=mine_of("unknown")), "terms: 'opt_gravity' is no field of numbers in MjModel"),
        (
            terms(x=mine_of("narrow")),
            "terms.x: the term has to return a dict of {'dof_armature': (6",
        ),
        (terms(x=mine_of("unmarked")), "terms.x: 'unmarked' does not say which fields it writes"),
    ],
)
def test_what_cannot_be_a_term_is_one_clear_line(build_env, override, message):
    with pytest.raises(ConfigError) as caught:
        build_env(override, num_envs=WORLDS)
    assert message in str(caught.value) and "\n" not in str(caught.value)
