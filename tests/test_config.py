"""Configurations: layers, overrides, and one clear line for what cannot be."""

from __future__ import annotations

import copy
import re
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import get_args, get_origin, get_type_hints

import pytest

from kiras_rl.config import (
    ConfigError,
    check_resume_overrides,
    config_from_dict,
    config_to_dict,
    list_configs,
    load_config,
    save_config,
)
from kiras_rl.envs import make_env
from kiras_rl.limits import LARGEST, LIMITS, SCHEDULES
from kiras_rl.phases import FINETUNING, phase_of, plan
from kiras_rl.ranges import RANGES, TERMS
from kiras_rl.runner import KirasRunner
from kiras_rl.schema import Config


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a YAML file and returns its path."""

    def write_file(text, name="mine.yaml"):
        path = tmp_path / name
        path.write_text(text)
        return str(path)

    return write_file


def refusal(*args):
    """Return the message with which a configuration is refused: always one line."""
    with pytest.raises(ConfigError) as caught:
        load_config(*args)
    message = str(caught.value)
    assert "\n" not in message
    return message


def pairs(kind, prefix=""):
    """List the dotted keys of a configuration that hold two numbers."""
    hints, keys = get_type_hints(kind), []
    for name in (field.name for field in fields(kind)):
        for option in (hints[name], *get_args(hints[name])):
            if is_dataclass(option):
                keys += pairs(option, f"{prefix}{name}.")
            elif get_origin(option) is tuple:
                keys.append(prefix + name)
    return keys


def numbers(kind, prefix=""):
    """List the dotted keys of a configuration that hold numbers, alone or in lists."""
    hints, keys = get_type_hints(kind), []
    for name in (field.name for field in fields(kind)):
        for option in (hints[name], *get_args(hints[name])):
            if is_dataclass(option):
                keys += numbers(option, f"{prefix}{name}.")
        text = str(hints[name])
        if hints[name] in (int, float) or re.search(r"\b(int|float)\b", text):
            keys.append(prefix + name)
    return keys


ZERO = {  # numbers whose range begins at zero; solo8 has no terrain in its first phase
    key: limits.above
    for key, limits in LIMITS.items()
    if limits.low == 0
    and "seed" not in key
    and key in numbers(Config)
    and key not in SCHEDULES
    and ".terrain." not in key
}
POSITIVE = [key for key, above in ZERO.items() if above]
NOT_NEGATIVE = [key for key, above in ZERO.items() if not above]


# --- layers and overrides ------------------------------------------------------------------------


def test_later_layers_win_and_overrides_come_last(write):
    write("extends: solo8\nseed: 5\nnum_envs: 7\n", "parent.yaml")
    child = write("extends: parent\nnum_envs: 8\nenv: {skills: {joint_noise: 0.3}}\n")
    config = load_config(child, ["num_envs=9", "env.rewards.terms.torques.weight=-1"])
    base = load_config("base")
    assert (config.seed, config.num_envs, config.env.skills.joint_noise) == (5, 9, 0.3)
    assert config.iterations == load_config("solo8").iterations
    assert config.env.skills.velocity_noise == base.env.skills.velocity_noise
    assert config.env.rewards.terms["torques"] == {"weight": -1}
    assert list(config.env.rewards.terms) == list(base.env.rewards.terms)


def test_null_removes_a_block_and_a_term():
    config = load_config("base", ["learner.imitation=null", "env.rewards.terms.torques=null"])
    assert config.learner.imitation is None
    assert config.learner.estimator is not None
    assert config.env.rewards.terms["torques"] is None


def test_a_removed_block_can_be_given_again_in_full(write):
    skill_init = "{floor: 0.02, smoothing: 0.5}"
    write("extends: base\nlearner: {skill_init: null}\n", "without.yaml")
    path = write(f"extends: without\nlearner: {{skill_init: {skill_init}}}\n")
    assert load_config(path).learner.skill_init.floor == 0.02


def test_a_saved_configuration_is_the_same_one(tmp_path):
    config = load_config("solo8", ["learner.skill_init=null"])
    assert config_from_dict(config_to_dict(config)) == config
    save_config(config, tmp_path / "config.yaml")
    assert load_config(str(tmp_path / "config.yaml")) == config


@pytest.mark.parametrize("overrides", [(), ["learner.estimator=null"]], ids=str)
def test_what_an_earlier_version_saved_is_read(overrides):
    config = load_config("solo8", overrides)
    values = config_to_dict(config)
    if values["learner"]["estimator"]:
        del values["learner"]["estimator"]["relative_step"]
        values["learner"]["estimator"] |= {"learning_rate": 1e-3, "full_rate_std": 0.5}
    before = copy.deepcopy(values)
    assert config_from_dict(values) == config
    assert values == before


def test_what_an_earlier_version_saved_of_finetuning_is_read():
    config = load_config("solo8")
    values = config_to_dict(config)
    values["finetuning"]["learner"]["estimator"]["learning_rate"] = 1e-3
    del values["finetuning"]["env"]["terrain"]["task"]  # younger than what was saved
    rebuilt = config_from_dict(values)
    assert phase_of(rebuilt, FINETUNING).config == phase_of(config, FINETUNING).config


@pytest.mark.parametrize("name", list_configs())
def test_every_shipped_configuration_builds_a_learner(name):
    config = load_config(name, ["num_envs=2"])
    runner = KirasRunner(make_env(config), plan(config)[0], None, "cpu")
    assert runner.env.num_envs == 2


@pytest.mark.parametrize("name", [name for name in list_configs() if name != "solo8_quick"])
def test_every_shipped_configuration_has_terrain_to_finetune_on(name):
    assert phase_of(load_config(name), FINETUNING).config.env.terrain


# --- refusals ------------------------------------------------------------------------------------


def test_an_unknown_key_is_refused_with_the_nearest_known_one():
    message = refusal("solo8", ["learner.ppo.gama=0.9"])
    assert message.startswith("override 'learner.ppo.gama=0.9': unknown key 'learner.ppo.gama'")
    assert "did you mean 'learner.ppo.gamma'? Allowed: num_steps, num_epochs" in message
    assert "unknown key 'xyz'. Allowed: robot, seed" in refusal("solo8", ["xyz.w=1"])


def test_an_unknown_key_names_the_file_that_holds_it(write):
    path = write("extends: base\nenv: {skils: {joint_noise: 0}}\n")
    assert refusal(path).startswith(f"{path}: unknown key 'env.skils'; did you mean 'env.skills'?")


@pytest.mark.parametrize(
    ("override", "part"),
    [
        ("num_envs=many", "num_envs: Value 'many' of type 'str' could not be converted to Integer"),
        ("num_envs=2.5", "num_envs: Value '2.5' of type 'float'"),
        ("num_envs=null", "num_envs: Incompatible value 'None'"),
        ("sim=null", "sim: field 'sim' is not Optional"),
        ("learner=3", "int is not a subclass of LearnerConfig"),
        ("env.commands.lin_vel_x=[0.3]", "length 1 does not match type hint length 2"),
        ("env.commands.lin_vel_x=[0.3,", "is not readable"),
        ("num_envs=${other}", "'other' not found"),
        ("num_envs", "write key=value, as in num_envs=512"),
        ("=3", "write key=value"),
    ],
)
def test_a_wrong_override_is_refused_and_named(override, part):
    message = refusal("solo8", [override])
    assert f"'{override}'" in message or "num_envs" in message
    assert part in message


@pytest.mark.parametrize("key", POSITIVE)
def test_what_must_be_positive_is_refused_at_zero(key):
    value = "[64, 0]" if key.endswith("_dims") else 0
    message = refusal("solo8", [f"{key}={value}"])
    assert message.startswith(f"{key}={value}") and message.endswith(": must be positive")


@pytest.mark.parametrize("key", NOT_NEGATIVE)
def test_what_must_not_be_negative_is_refused_below_zero(key):
    message = refusal("solo8", [f"{key}={'[-1,0]' if key in pairs(Config) else -1}"])
    limits = LIMITS[key]
    allowed = "must not be negative" if limits.high >= LARGEST else f"allowed are {limits}"
    assert message.startswith(f"{key}=") and message.endswith(f": {allowed}")


def test_every_number_has_a_range():
    assert set(numbers(Config)) - set(LIMITS) == set()


def test_the_page_on_configuration_shows_every_range():
    page = (Path(__file__).parents[1] / "docs" / "configuration.md").read_text(encoding="utf-8")
    known = set(numbers(Config))
    for key, limits in LIMITS.items():
        assert key not in known or f"| `{key}` | {limits} |" in page, f"| `{key}` | {limits} |"


@pytest.mark.parametrize(
    "override",
    [
        "env.rewards.terms.tracking_lin_vel.sigma=0",
        "env.rewards.terms.torques.weight=1.0e30",
        "env.observations.proprio.joint_pos.scale=0",
        "env.observations.proprio.joint_pos.noise=-1",
        "finetuning.env.terrain.types.stairs_up.proportion=-1",
        "learner.ppo.gamma=1.5",
        "learner.ppo.num_steps=1",
        "env.skills.switch_probability=7",
        "env.terminations.terms.tilted.angle=400",
        "learner.ppo.action_std=[[0,0.5],[1,1000]]",
        "env.terminations.episode_length=0.001",
        "num_envs=2000000000",
    ],
)
def test_what_is_outside_of_its_range_is_refused(override):
    with pytest.raises(ConfigError) as caught:
        phase_of(load_config("solo8", [override]), FINETUNING)
    assert override.partition("=")[0].removeprefix("finetuning.") in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("key", ["learner.ppo.actor_dims", "learner.ppo.critic_dims"])
def test_policy_and_critic_have_a_hidden_layer(key):
    assert refusal("solo8", [f"{key}=[]"]) == f"{key}=[]: give one number at least"


@pytest.mark.parametrize(
    ("override", "allowed"),
    [
        ("seed=-1", f"0 to {2**63 - 1}"),
        (f"seed={2**63}", f"0 to {2**63 - 1}"),
        ("learner.skill_init.floor=-0.1", "0 to 1"),
        ("learner.skill_init.floor=1.5", "0 to 1"),
    ],
)
def test_what_has_limits_is_refused_outside_of_them(override, allowed):
    assert refusal("solo8", [override]) == f"{override}: allowed are {allowed}"


def test_the_largest_seed_is_one_of_torch():
    env = make_env(load_config("solo8", ["num_envs=1", f"seed={2**63 - 1}"]))
    assert env.num_envs == 1


@pytest.mark.parametrize("key", [key for key in RANGES if not key.startswith("env.terrain.")])
def test_a_range_begins_with_its_lower_end(key):
    message = refusal("solo8", [f"{key}=[4,3]"])
    assert message.startswith(f"{key}=[4")
    assert message.endswith(": give [low, high], the lower number first")
    assert load_config("solo8", [f"{key}=[3,3]"])


def test_every_pair_is_a_range_but_that_of_the_levels_of_terrain():
    assert set(pairs(Config)) == {*RANGES, "env.terrain.noise"}


@pytest.mark.parametrize(
    ("override", "shown"),
    [
        ("checkpoint_minutes=.nan", "nan"),
        ("evaluation.duration=.inf", "inf"),
        ("env.commands.lin_vel_x=[-.inf,1]", "[-inf, 1.0]"),
        ("learner.ppo.action_std=[[0,.inf]]", "[[0.0, inf]]"),
        ("env.rewards.terms.torques.weight=.nan", "nan"),
        ("env.observations.critic.base_lin_vel.scale=.inf", "inf"),
        ("finetuning.retention.residual_weight=.nan", "nan"),
        ("finetuning.env.terrain.types.stairs_up.riser=[0.1,.nan]", "[0.1, nan]"),
        ("finetuning.env.terrain.types.stairs_up.proportion=.nan", "nan"),
    ],
)
def test_what_is_not_finite_is_refused_wherever_it_stands(override, shown):
    key = override.partition("=")[0]
    assert refusal("solo8", [override]) == f"{key}={shown}: must be finite"


@pytest.mark.parametrize(
    ("override", "shown"),
    [
        ("env.rewards.terms.torques.weight=null", "null"),
        ("env.rewards.terms.torques.weight=true", "True"),
        ("env.observations.proprio.joint_pos.noise=abc", "'abc'"),
        ("env.observations.proprio.joint_pos.scale=null", "null"),
        ("env.observations.critic.base_lin_vel.scale=[1]", "[1]"),
        ("env.observations.imitation.joint_pos.noise='0.1'", "'0.1'"),
    ],
)
def test_what_scales_a_term_is_a_number(override, shown):
    key = override.partition("=")[0]
    assert refusal("solo8", [override]) == f"{key}={shown}: must be a number"


@pytest.mark.parametrize(("value", "shown"), [("abc", "'abc'"), ("null", "null"), ("[1]", "[1]")])
def test_a_parameter_of_a_reward_is_a_number(value, shown):
    key = "env.rewards.terms.short_swing.least"
    config = load_config("solo8", ["num_envs=1", f"{key}={value}"])
    with pytest.raises(ConfigError) as caught:
        make_env(config)
    assert str(caught.value) == f"{key}={shown}: must be a number"


@pytest.mark.parametrize("key", [key for key in TERMS if "terrain" not in key])
def test_of_every_group_of_terms_one_is_left(key):
    group = config_to_dict(load_config("solo8"))
    for part in key.split("."):
        group = group[part]
    message = refusal("solo8", [f"{key}.{name}=null" for name in group])
    assert message == f"{key}: nothing is left of it; keep one entry at least"


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("env.terrain.seed=-1", f"allowed are 0 to {2**63 - 1}"),
        ("env.terrain.types.stairs_up.proportion='abc'", "must be a number"),
        ("env.rewards.terms.torques.weight='abc'", "must be a number"),
        ("env.terrain.task.lin_vel_x=[0.6, 0.3]", "give [low, high], the lower number first"),
        ("env.commands.lin_vel_x=[0.6, 0.3]", "give [low, high], the lower number first"),
        ("learner.ppo.learning_rate=-1.0", "allowed are 0 to 10"),
    ],
)
def test_the_changes_of_finetuning_are_looked_at_with_what_they_change(override, message):
    config = load_config("solo8", [f"finetuning.{override}"])
    with pytest.raises(ConfigError) as caught:
        phase_of(config, FINETUNING)
    assert str(caught.value) == f"finetuning: {override}: {message}"


@pytest.mark.parametrize(
    ("key", "points"),
    [(key, "[[1,0.1],[0,0.5]]") for key in SCHEDULES]
    + [(SCHEDULES[0], points) for points in ("[]", "[[0.5]]", "[[0,1,2]]")],
)
def test_a_schedule_is_a_list_of_points_in_order(key, points):
    assert "give [share of the phase, value] points" in refusal("solo8", [f"{key}={points}"])


@pytest.mark.parametrize("points", ["[]", "[[0.5,1],[0,1]]", "[[0,a]]", "[1,2]"])
def test_a_weight_is_a_number_or_a_schedule(points):
    key = "env.rewards.terms.torques.weight"
    message = refusal("solo8", [f"{key}={points}"])
    assert message.startswith(f"{key}=") and "give a number or [share of the phase" in message


@pytest.mark.parametrize("last", [0, -0.1])
def test_action_noise_never_ends(last):
    message = refusal("solo8", [f"learner.ppo.action_std=[[0,0.5],[1,{last}]]"])
    assert message.endswith(": must be positive")


def test_a_rollout_must_fill_its_batches():
    message = refusal("solo8", ["num_envs=2", "learner.ppo.num_mini_batches=49"])
    assert message.startswith("learner.ppo.num_mini_batches=49: at most the 48 steps of a rollout")


def test_what_is_removed_is_not_looked_at():
    assert load_config("base", ["learner.imitation=null"]).learner.imitation is None


def test_a_missing_value_is_named(write):
    message = refusal(write("seed: 3\n"))
    assert "leaves out: " in message
    assert "num_envs" in message and "extend base or set them" in message


def test_a_part_of_a_removed_block_is_refused():
    overrides = ["learner.imitation=null", "learner.imitation.reward_weight=2"]
    assert "leaves out: learner.imitation.discriminator" in refusal("base", overrides)


def test_extends_in_a_circle_is_refused(write):
    write("extends: b\n", "a.yaml")
    path = write("extends: a\n", "b.yaml")
    assert "'extends' goes round in circles" in refusal(path)


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("a: b: c", "is not readable YAML"),
        ("- 1\n- 2\n", "holds no keys"),
        ("extends: [base]\n", "extends: give one name"),
        ("extends: bsae\n", "no configuration 'bsae': did you mean 'base'?"),
    ],
)
def test_an_unusable_file_is_refused(write, text, part):
    assert part in refusal(write(text))


def test_an_unknown_name_lists_the_shipped_ones():
    message = refusal("solo9")
    assert message.startswith("no configuration 'solo9': did you mean 'solo8'?")
    assert "ablations/no_sil" in message


def test_a_resumed_run_stays_the_same_run():
    check_resume_overrides(["iterations=5", "device=cpu", "sim.threads=1"])
    with pytest.raises(ConfigError, match="'num_envs' cannot change when a run is resumed"):
        check_resume_overrides(["iterations=5", "num_envs=5"])


def test_of_the_quick_configuration_nothing_but_pushes_is_random():
    drawn = vars(load_config("solo8_quick").env.randomization)
    left = {name for name, value in drawn.items() if value is not None}
    assert left == {"push_velocity", "push_interval"}
