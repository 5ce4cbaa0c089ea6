"""What the learner sees: widths, noise, history, and nothing that changes behind its back."""

from __future__ import annotations

import pytest
import torch

from kiras_rl.config import ConfigError, load_config
from kiras_rl.envs import observations
from kiras_rl.envs.observations import View
from kiras_rl.interfaces import COMMAND, CRITIC, HISTORY, IMITATION, NEXT_PROPRIO, PROPRIO
from kiras_rl.phases import plan
from kiras_rl.runner import KirasRunner

FIXED_TASK = (
    "env.skills.switch_probability=0",
    "env.commands.resample_probability=0",
    "env.randomization.push_velocity=null",
)


def random_steps(env, count, std=0.7):
    """Step with random actions; yield the observation before, and what the step returned."""
    obs = env.get_observations()
    for _ in range(count):
        following, _, dones, extras = env.step(std * torch.randn(env.num_envs, 8))
        yield obs, following, dones, extras
        obs = following


def terms(env):
    """Return where each term lies in proprio."""
    slices, start = {}, 0
    for term in env.describe()["observation"]:
        slices[term["name"]] = slice(start, start + term["size"])
        start += term["size"]
    return slices


def clean(env, obs):
    """Return the noise-free proprio part, which leads the critic's observation."""
    return obs[CRITIC][:, : obs[PROPRIO].shape[1]]


def widths(module):
    """Return the inputs and outputs of a network."""
    linear = [m for m in module.modules() if isinstance(m, torch.nn.Linear)]
    return linear[0].in_features, linear[-1].out_features


# --- widths --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cfg", "proprio", "critic", "imitation", "actor"),
    [("solo8", 34, 107, 17, 45), ("solo8_paper_dims", 31, 107, 19, 42)],
)
def test_widths_are_those_of_the_preset(build_env, cfg, proprio, critic, imitation, actor):
    env = build_env(cfg=cfg, num_envs=2)
    obs = env.get_observations()
    shown = {name: obs[name].shape[1] for name in (PROPRIO, HISTORY, CRITIC, IMITATION)}
    assert shown == {
        PROPRIO: proprio, HISTORY: 4 * proprio, CRITIC: critic, IMITATION: imitation
    }  # fmt: skip
    assert env.keyframe_features.shape == (5, imitation)
    assert env.keyframe_observations().shape == (5, 3, critic)
    alg = KirasRunner(env, plan(load_config(cfg))[0], None, "cpu").alg
    assert widths(alg.actor.mlp) == (actor, 8)
    assert widths(alg.parts["estimator"].estimator.encoder) == (4 * proprio, 3 + 2 * 8)
    assert widths(alg.parts["estimator"].estimator.decoder) == (8 + 5, proprio)
    assert widths(alg.parts["imitation"].discriminator) == (2 * imitation, 1)
    assert widths(alg.critic.critics[0]) == (critic, 1)


def test_null_removes_a_term_and_a_name_adds_one(build_env):
    env = build_env(
        "env.observations.proprio.joint_vel=null",
        "env.observations.proprio.base_ang_vel={scale: 0.25}",
        num_envs=2,
    )
    assert list(terms(env)) == [
        "projected_gravity", "command_lin_vel_x", "command_ang_vel_z", "skill", "joint_pos",
        "last_action", "base_ang_vel",
    ]  # fmt: skip
    assert env.get_observations()[PROPRIO].shape == (2, 34 - 8 + 3)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("proprio.skil={}", "env.observations.proprio: no term 'skil': did you mean 'skill'?"),
        ("critic.foot_height={scal: 2}", "critic.foot_height: unknown key 'scal'; it takes scale"),
        ("proprio.skill=3", "proprio.skill: give scale and noise, as in skill: {scale: 1.0}"),
    ],
)
def test_a_term_that_cannot_be_is_refused(build_env, override, message):
    with pytest.raises(ConfigError) as caught:
        build_env(f"env.observations.{override}", num_envs=1)
    assert message in str(caught.value)


# --- noise and history ---------------------------------------------------------------------------


def test_noise_stays_within_its_bounds_and_fills_them(build_env, nominal):
    env = build_env(*nominal)
    noise = torch.cat(
        [obs[PROPRIO] - clean(env, obs) for obs, *_ in random_steps(env, 60)]
    ).abs()  # fmt: skip
    bound = {"projected_gravity": 0.05, "joint_pos": 0.01, "joint_vel": 1.5 * 0.05}
    for name, where in terms(env).items():
        largest = noise[:, where].amax(dim=0)
        assert (largest <= bound.get(name, 0.0) + 1e-6).all()
        assert (largest >= 0.9 * bound.get(name, 0.0)).all()


def test_without_noise_and_errors_the_robot_sees_what_the_critic_sees(build_env, nominal):
    env = build_env("env.observations.noise=false", *nominal)
    for obs, *_ in random_steps(env, 3):
        assert torch.equal(obs[PROPRIO], clean(env, obs))


def test_history_holds_the_frames_before_this_one_oldest_first(build_env):
    env = build_env("env.terminations.episode_length=0.3")
    frames = [env.get_observations()[PROPRIO]] * 5
    resets = 0
    for _, obs, dones, _ in random_steps(env, 40):
        copies = obs[PROPRIO].repeat(1, 4)
        expected = torch.where(dones[:, None], copies, torch.cat(frames[-4:], dim=1))
        assert torch.equal(obs[HISTORY], expected)
        frames = [torch.where(dones[:, None], obs[PROPRIO], f) for f in frames[-4:]]
        frames.append(obs[PROPRIO])
        resets += dones.sum()
    assert resets > env.num_envs


def test_an_episode_begins_as_if_the_robot_had_held_its_pose(build_env):
    env = build_env("env.observations.noise=false")
    obs, where = env.reset(), terms(env)
    scale = env.describe()["action_scale"][0]
    offset = obs[PROPRIO][:, where["joint_pos"]]
    torch.testing.assert_close(scale * obs[PROPRIO][:, where["last_action"]], offset)


# --- the contract with the learner ---------------------------------------------------------------


@pytest.mark.parametrize("cfg", ["solo8", "solo8_paper_dims"])
def test_what_follows_a_step_is_what_the_next_observation_shows(build_env, cfg):
    env = build_env("env.terminations.episode_length=0.3", *FIXED_TASK, cfg=cfg)
    ends = 0
    for _, following, dones, extras in random_steps(env, 60):
        goes_on = ~dones
        assert torch.equal(extras["imitation"][goes_on], following[IMITATION][goes_on])
        assert torch.equal(extras[NEXT_PROPRIO][goes_on], clean(env, following)[goes_on])
        ends += dones.sum()
    assert ends > 0


def test_after_an_end_the_extras_still_tell_of_the_old_episode(build_env):
    env = build_env("env.terminations.random_first_length=false", *FIXED_TASK)
    env.episode_length_buf = torch.full((env.num_envs,), env.max_episode_length - 1)
    before = env.get_observations()
    hold = before[PROPRIO][:, terms(env)["last_action"]]
    following, _, dones, extras = env.step(hold)
    assert dones.all() and extras["time_outs"].all()
    skill = slice(3, 8)  # in Phi: gravity, skill, joints, height
    assert torch.equal(extras["imitation"][:, skill], before[IMITATION][:, skill])
    joints = slice(8, 16)
    moved = (extras["imitation"] - before[IMITATION])[:, joints].abs().amax(dim=1)
    reset = (following[IMITATION] - before[IMITATION])[:, joints].abs().amax(dim=1)
    assert moved.max() < 0.3
    assert reset.max() > 0.3


def test_observations_stay_as_they_were(build_env):
    env = build_env("env.terminations.episode_length=0.1")
    kept, copies = [], []
    for obs, _, _, extras in random_steps(env, 8):
        for values in (obs, {k: v for k, v in extras.items() if torch.is_tensor(v)}):
            kept += values.values()
            copies += [value.clone() for value in values.values()]
    assert all(torch.equal(a, b) for a, b in zip(kept, copies, strict=True))


def test_every_number_tells_something(build_env):
    env = build_env(num_envs=16)
    seen = torch.stack([obs.clone() for obs, *_ in random_steps(env, 100)]).flatten(0, 1)
    constant = {name: (group.std(dim=0) < 1e-3).nonzero().flatten().tolist()
                for name, group in seen.items()}  # fmt: skip
    assert constant.pop(COMMAND) == [1]  # Solo-8 is never asked to walk sideways
    assert constant == {name: [] for name in constant}


@pytest.mark.parametrize("cfg", ["solo8", "solo8_paper_dims"])
def test_a_robot_in_a_keyframe_shows_the_keyframe_s_features(build_env, cfg):
    env = build_env("env.skills.joint_noise=0", cfg=cfg, num_envs=5)
    skills = torch.arange(5)
    obs = env.reset(skills, torch.zeros(5, 3))
    # a robot is put down 2 mm above the ground, and lengths are scaled by 10
    torch.testing.assert_close(obs[IMITATION], env.keyframe_features, atol=0.021, rtol=0)


def test_a_critic_may_see_all_that_a_robot_has(build_env, monkeypatch):
    def everything(view: View) -> torch.Tensor:
        robot = view.robot
        parts = (robot.foot_contact, robot.foot_force, robot.base_force, robot.limb_force,
                 robot.foot_vel_w.flatten(1), robot.joint_torque, robot.base_quat_w,
                 robot.yaw_rate[:, None], robot.yaw[:, None])  # fmt: skip
        return torch.cat([part.float() for part in parts], dim=1)

    monkeypatch.setattr(observations, "everything", everything, raising=False)
    env = build_env("env.observations.critic.everything={}", num_envs=5)
    at_rest, seen = env.keyframe_observations(), env.get_observations()[CRITIC]
    assert at_rest.shape[-1] == seen.shape[1] == 107 + 43
    pitch = env.keyframe_pitch[:, None, None]
    assert (at_rest[..., 107:111] == 1.0).all()  # feet on the ground
    torch.testing.assert_close(at_rest[..., -4:-3], (pitch / 2).sin().expand(5, 3, 1))  # y of it


def test_keyframes_are_judged_at_rest_for_several_commands(build_env):
    still = ("env.skills.joint_noise=0", "env.skills.velocity_noise=0")
    env = build_env(*still, "env.randomization.encoder_bias=null", num_envs=5)
    at_rest = env.keyframe_observations()
    where = terms(env)["command_lin_vel_x"]
    expected = 2.0 * 0.6 * torch.tensor([0.0, 0.4, 0.8])  # scale, largest v_x
    torch.testing.assert_close(at_rest[:, :, where].squeeze(-1), expected.expand(5, 3))
    obs = env.reset(torch.arange(5), torch.zeros(5, 3))
    torch.testing.assert_close(obs[CRITIC], at_rest[:, 0], atol=0.021, rtol=0)
