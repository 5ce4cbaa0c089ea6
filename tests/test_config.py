"""Configurations: layers, overrides, and one clear line for what cannot be."""

from __future__ import annotations

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
from kiras_rl.ranges import POSITIVE, SCHEDULES
from kiras_rl.runner import KirasRunner


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


@pytest.mark.parametrize("name", list_configs())
def test_every_shipped_configuration_builds_a_learner(name):
    config = load_config(name, ["num_envs=2"])
    runner = KirasRunner(make_env(config), config, None, "cpu")
    assert runner.env.num_envs == 2


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


@pytest.mark.parametrize("key", [key for key in POSITIVE if "terrain" not in key])
def test_what_must_be_positive_is_refused_at_zero(key):
    assert refusal("solo8", [f"{key}=0"]).endswith(": must be positive")


@pytest.mark.parametrize(
    ("key", "points"),
    [(key, "[[1,0.1],[0,0.5]]") for key in SCHEDULES]
    + [(SCHEDULES[0], points) for points in ("[]", "[[0.5]]", "[[0,1,2]]")],
)
def test_a_schedule_is_a_list_of_points_in_order(key, points):
    assert "give [fraction of T1, value] points" in refusal("solo8", [f"{key}={points}"])


@pytest.mark.parametrize("last", [0, -0.1])
def test_action_noise_never_ends(last):
    message = refusal("solo8", [f"learner.ppo.action_std=[[0,0.5],[1,{last}]]"])
    assert message.endswith(": every value must be positive")


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
