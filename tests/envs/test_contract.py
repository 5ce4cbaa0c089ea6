"""The environment's promises, for every robot there is."""

from __future__ import annotations

import pytest
import torch
from rsl_rl.runners import OnPolicyRunner

from kiras_rl import interfaces as names
from kiras_rl.config import ConfigError
from kiras_rl.envs import resolve_backend
from kiras_rl.evaluation.flat import evaluate_skills
from kiras_rl.robots.robot import list_robots, load_robot

WORLDS = 10
UPSIDE_DOWN = [0.0, 1.0, 0.0, 0.0]
STILL = ("env.skills.joint_noise=0", "env.skills.velocity_noise=0")


@pytest.fixture(params=list_robots())
def robot(request):
    return load_robot(request.param)


@pytest.fixture
def env(robot, build_env):
    """Worlds of a robot with everything random that can be."""
    return build_env(f"robot={robot.name}", num_envs=WORLDS)


def actions(env, std=0.5):
    return std * torch.randn(env.num_envs, env.num_actions)


def hold(env):
    """Return the actions that ask for the joints' present angles."""
    robot = load_robot(env.describe()["robot"])
    offset = env.robot.joint_pos - torch.tensor(robot.default_joint_pos).float()
    return offset / torch.tensor(robot.action_scale).float()


def assert_same(obs, other):
    for name, group in obs.items():
        assert torch.equal(group, other[name]), name


def place(env, worlds, height=None, quat=None):
    """Lift or turn some worlds by hand."""
    mask = torch.zeros(env.num_envs, dtype=torch.bool)
    mask[worlds] = True
    qpos = env.sim.qpos.clone()
    if height is not None:
        qpos[:, 2] = height
    if quat is not None:
        qpos[:, 3:7] = torch.tensor(quat)
    env.sim.write_state(mask, qpos, torch.zeros_like(env.sim.qvel), qpos[:, 7:])


# --- shapes and repeatability --------------------------------------------------------------------


def test_a_step_returns_what_was_promised(env, robot):
    skills, joints = len(robot.skills), len(robot.joint_names)
    for _ in range(20):
        obs, rewards, dones, extras = env.step(actions(env))
    assert env.num_actions == joints
    assert sum(size for _, size, _ in env.imitation_terms) == env.keyframe_features.shape[1]
    proprio = obs[names.PROPRIO].shape[1]
    shapes = {name: tuple(group.shape) for name, group in obs.items()}
    assert shapes == {
        names.PROPRIO: (WORLDS, proprio),
        names.HISTORY: (WORLDS, 4 * proprio),
        names.CRITIC: (WORLDS, proprio + 3 + 3 + len(robot.foot_geoms) + 63),
        names.IMITATION: (WORLDS, *env.keyframe_features.shape[1:]),
        names.VELOCITY: (WORLDS, 3),
        names.SKILL: (WORLDS, skills),
        names.COMMAND: (WORLDS, 3),
    }
    assert all(group.dtype == torch.float32 and group.isfinite().all() for group in obs.values())
    assert (rewards.shape, dones.shape, dones.dtype) == ((WORLDS,), (WORLDS,), torch.bool)
    assert rewards.isfinite().all()
    for name in (names.EXTRA_TIME_OUTS, names.EXTRA_VALID):
        assert (extras[name].shape, extras[name].dtype) == ((WORLDS,), torch.bool)
    assert extras[names.EXTRA_IMITATION].shape == obs[names.IMITATION].shape
    assert extras[names.NEXT_PROPRIO].shape == obs[names.PROPRIO].shape
    parts = [value for key, value in extras["log"].items() if key.startswith("Reward/")]
    torch.testing.assert_close(torch.stack(parts).sum(), rewards.mean())


def test_measurements_outlive_the_next_step(env):
    env.step(actions(env))
    now = env.measure()
    kept = {name: value.clone() for name, value in vars(now).items()}
    env.step(actions(env))
    assert all(torch.equal(getattr(now, name), value) for name, value in kept.items())


def test_nothing_is_measured_before_the_first_step(env):
    with pytest.raises(RuntimeError, match="before the first step"):
        env.measure()


def test_flat_ground_leaves_no_tile_to_choose(env):
    of_each = torch.zeros(WORLDS, dtype=torch.int64)
    with pytest.raises(ValueError, match="all ground is flat"):
        env.place(of_each, of_each)


def test_the_height_of_the_feet_follows_from_what_is_measured(robot, build_env, nominal):
    env = build_env(f"robot={robot.name}", *nominal, num_envs=WORLDS)
    env.step(actions(env))
    now = env.measure()
    height = now.base_height[:, None] + env.foot_height_b(now.gravity_b, now.joint_pos)
    assert not now.fallen.any()
    torch.testing.assert_close(height, env.robot.foot_height)


def test_the_same_seed_gives_the_same_motion(robot, build_env):
    runs = []
    for seed in (1, 1, 2):
        env = build_env(f"robot={robot.name}", f"seed={seed}", num_envs=WORLDS)
        torch.manual_seed(7)
        steps = [env.step(actions(env)) for _ in range(30)]
        runs.append((torch.stack([s[0] for s in steps]), torch.stack([s[1] for s in steps])))
    (obs, rewards), (same_obs, same_rewards), (other_obs, _) = runs
    assert torch.equal(rewards, same_rewards)
    assert_same(obs, same_obs)
    assert not torch.equal(obs[names.PROPRIO], other_obs[names.PROPRIO])


def test_a_saved_state_goes_on_bit_for_bit(robot, build_env):
    env = build_env(f"robot={robot.name}", num_envs=WORLDS)
    other = build_env(f"robot={robot.name}", "seed=3", num_envs=WORLDS)
    for _ in range(20):
        env.step(actions(env))
    env.set_skill_probabilities(torch.tensor([0.1, 0.2, 0.3, 0.2, 0.2]))
    other.load_state_dict(env.state_dict())
    assert_same(env.get_observations(), other.get_observations())
    for _ in range(20):
        given = actions(env)
        obs, rewards, dones, _ = env.step(given)
        other_obs, other_rewards, other_dones, _ = other.step(given)
        assert torch.equal(rewards, other_rewards) and torch.equal(dones, other_dones)
        assert_same(obs, other_obs)


# --- resets --------------------------------------------------------------------------------------


def test_a_reset_puts_the_lowest_foot_just_above_the_ground(env):
    env.reset()
    lowest = env.robot.foot_height.amin(dim=1)
    torch.testing.assert_close(lowest, torch.full((WORLDS,), 0.002), atol=1e-5, rtol=0)


def test_a_reset_is_near_the_keyframe_of_its_start(robot, build_env):
    env = build_env(f"robot={robot.name}", "env.skills.start_at_target=0", num_envs=50)
    env.reset()
    start = env.task.start
    assert (start != env.task.skill).all()
    assert start.unique().tolist() == [0, 1, 2, 3, 4]
    error = env.robot.joint_pos - env.keyframes.joint_pos[start]
    assert 0.08 < error.abs().max() <= 0.1
    torch.testing.assert_close(env.robot.roll_pitch[:, 1], env.keyframe_pitch[start])
    assert 0.15 < env.sim.qvel[:, :2].abs().max() <= 0.2


def test_a_given_skill_starts_at_its_own_keyframe_and_stays(robot, build_env):
    env = build_env(f"robot={robot.name}", "env.skills.switch_probability=1", *STILL, num_envs=5)
    command = torch.tensor([[0.3, 0.0, 0.1]]).repeat(5, 1)
    env.reset(torch.arange(5), command)
    torch.testing.assert_close(env.robot.joint_pos, env.keyframes.joint_pos)
    torch.testing.assert_close(env.robot.base_height, env.keyframe_height + 0.002)
    env.episode_length_buf = torch.full((5,), env.max_episode_length - 1)
    for _ in range(2):
        obs, _, dones, _ = env.step(hold(env))
        assert torch.equal(obs[names.SKILL].argmax(1), torch.arange(5))
        assert torch.equal(obs[names.COMMAND], command)
    assert not dones.any()  # the clock ended the first step


def test_a_new_task_changes_the_task_and_nothing_else(env):
    for _ in range(3):
        env.step(actions(env))
    before = env.get_observations().clone()
    skill, command = torch.arange(WORLDS) % 3, torch.full((WORLDS, 3), 0.25)
    after = env.set_task(skill, command).clone()
    assert torch.equal(after[names.SKILL].argmax(1), skill)
    assert torch.equal(after[names.COMMAND], command)
    where, task = 0, []
    for term in env.describe()["observation"]:
        is_task = term["name"].startswith(("command", "skill"))
        task += [is_task] * term["size"]
        where += term["size"]
    same = ~torch.tensor(task)
    torch.testing.assert_close(after[names.PROPRIO][:, same], before[names.PROPRIO][:, same])
    for name in (names.HISTORY, names.VELOCITY):
        assert torch.equal(after[name], before[name])
    for _ in range(3):
        obs = env.step(actions(env))[0]
        assert torch.equal(obs[names.SKILL].argmax(1), skill)


def test_skills_are_drawn_by_their_probabilities(build_env):
    env = build_env(num_envs=500)
    probabilities = torch.tensor([0.0, 0.1, 0.2, 0.3, 0.4])
    env.set_skill_probabilities(probabilities)
    drawn = env.reset()[names.SKILL].mean(dim=0)
    assert drawn[0] == 0.0
    torch.testing.assert_close(drawn, probabilities, atol=0.08, rtol=0)  # 4 standard deviations


def test_skills_and_commands_change_now_and_then_within_an_episode(build_env, nominal):
    env = build_env(
        "env.skills.switch_probability=0.1", "env.commands.resample_probability=0.2", *STILL,
        *nominal, num_envs=250,
    )  # fmt: skip
    before = env.get_observations()
    after, _, dones, _ = env.step(hold(env))
    skills = (before[names.SKILL] != after[names.SKILL]).any(dim=1)[~dones]
    commands = (before[names.COMMAND] != after[names.COMMAND]).any(dim=1)[~dones]
    assert skills.float().mean().item() == pytest.approx(0.08, abs=0.07)  # a fifth draws the same
    assert commands.float().mean().item() == pytest.approx(0.2, abs=0.1)


def test_commands_stay_in_their_ranges_and_some_ask_to_stand(build_env):
    env = build_env("env.commands.lin_vel_y=[-0.1,0.2]", num_envs=500)
    command = env.reset()[names.COMMAND]
    stands = (command == 0).all(dim=1)
    assert stands.float().mean().item() == pytest.approx(0.1, abs=0.054)
    low, high = command.amin(dim=0), command.amax(dim=0)
    torch.testing.assert_close(low, torch.tensor([-0.4, -0.1, -0.6]), atol=0.03, rtol=0)
    torch.testing.assert_close(high, torch.tensor([0.6, 0.2, 0.6]), atol=0.03, rtol=0)


# --- ends ----------------------------------------------------------------------------------------


def test_the_clock_ends_an_episode_without_a_fall(env):
    env.reset()
    env.episode_length_buf = torch.arange(WORLDS) + env.max_episode_length - WORLDS
    for step in range(WORLDS):
        _, _, dones, extras = env.step(hold(env))
        late = torch.arange(WORLDS) == WORLDS - 1 - step
        assert torch.equal(extras[names.EXTRA_TIME_OUTS] & late, dones & late)
        assert torch.equal(env.episode_length_buf == 0, dones)
        assert torch.equal(dones, extras[names.EXTRA_TIME_OUTS] | env.measure().fallen)


def test_first_episodes_end_one_after_the_other(build_env):
    spread = build_env(num_envs=100).episode_length_buf.float() / 1000
    assert spread.std().item() == pytest.approx((1 / 12) ** 0.5, abs=0.06)  # uniform on [0, 1]
    together = build_env("env.terminations.random_first_length=false")
    assert not together.episode_length_buf.any()


def test_a_fall_ends_an_episode_and_is_no_time_out(env):
    env.reset()
    place(env, [2, 5], height=1.0, quat=UPSIDE_DOWN)
    env.episode_length_buf = torch.full((WORLDS,), env.max_episode_length - 1)
    _, rewards, dones, extras = env.step(hold(env))
    fallen = torch.zeros(WORLDS, dtype=torch.bool)
    fallen[[2, 5]] = True
    assert torch.equal(env.measure().fallen, fallen)
    assert torch.equal(extras[names.EXTRA_TIME_OUTS], ~fallen)
    assert dones.all()
    assert extras["log"]["Episode/falls"] == 2 and extras["log"]["Episode/time_outs"] == WORLDS - 2
    assert rewards[fallen].mean() < rewards[~fallen].mean() - 1.0
    assert extras["log"]["Reward/termination"].item() == pytest.approx(-2.0 * 2 / WORLDS)


def test_a_trunk_on_the_ground_is_a_fall(robot, build_env):
    env = build_env(f"robot={robot.name}", "env.terminations.terms.tilted.angle=180", num_envs=3)
    env.reset(torch.zeros(3, dtype=torch.int64), torch.zeros(3, 3))
    place(env, [1], height=0.15, quat=UPSIDE_DOWN)  # legs up: the trunk comes down first
    fallen = torch.zeros(3, dtype=torch.bool)
    for _ in range(15):
        env.step(hold(env))
        fallen |= env.measure().fallen
    assert fallen.tolist() == [False, True, False]


def test_a_lean_is_judged_from_the_nearer_of_target_and_start(build_env, nominal):
    env = build_env("env.terminations.terms.tilted.angle=20", *STILL, *nominal, num_envs=4)
    pitch_up = torch.full((4,), env.skills.index("pitch_up"))
    env.reset(pitch_up, torch.zeros(4, 3))  # 15 degrees nose up
    env.set_task(torch.tensor([3, 4, 0, 4]), torch.zeros(4, 3))  # itself, or 30 degrees away
    env.step(hold(env))
    assert not env.measure().fallen.any()  # where the episode began is near enough
    place(env, [3], height=0.5, quat=[1.0, 0.0, 0.0, 0.0])  # level: 15 degrees from both
    env.step(hold(env))
    assert not env.measure().fallen.any()
    nose_down = [0.9537, 0.0, 0.3007, 0.0]  # 35 degrees: 20 from pitch_down, 50 from pitch_up
    place(env, [0], height=0.5, quat=nose_down)
    env.step(hold(env))
    assert env.measure().fallen.tolist() == [True, False, False, False]


def test_a_lean_that_was_asked_for_before_is_no_fall(build_env, nominal):
    env = build_env("env.terminations.terms.tilted.angle=10", *STILL, *nominal, num_envs=1)
    walk, pitch_down = (torch.tensor([env.skills.index(x)]) for x in ("walk", "pitch_down"))
    env.reset(walk, torch.zeros(1, 3))
    env.set_task(pitch_down, torch.zeros(1, 3))
    place(env, [0], height=0.5, quat=[0.9914, 0.0, 0.1305, 0.0])  # 15 degrees nose down
    env.set_task(walk, torch.zeros(1, 3))
    env.step(hold(env))
    assert not env.measure().fallen.any()


def test_a_world_whose_physics_breaks_ends_and_harms_no_other(env):
    for _ in range(3):
        env.step(actions(env))
    broken = torch.arange(WORLDS) == 4
    env.sim.write_velocity(broken, torch.full_like(env.sim.qvel, torch.nan))
    obs, rewards, dones, extras = env.step(actions(env))
    assert torch.equal(~extras[names.EXTRA_VALID], broken)
    assert extras["log"]["Sim/diverged"] == 1
    assert dones[4] and not extras[names.EXTRA_TIME_OUTS][4]
    assert rewards[4].item() == pytest.approx(-2.0)  # the termination and nothing else
    for _ in range(3):
        everything = [*obs.values(), rewards, extras["imitation"], extras["next_proprio"]]
        assert all(value.isfinite().all() for value in everything)
        obs, rewards, dones, extras = env.step(actions(env))


# --- those who use it ----------------------------------------------------------------------------


def test_an_evaluation_repeats_whatever_happened_before(build_env):
    env = build_env("env.terminations.random_first_length=false", num_envs=WORLDS)
    policy = torch.nn.Linear(34, 8)

    def act(obs):
        return policy(obs[names.PROPRIO])

    first = evaluate_skills(env, act, duration=1.4, command=0.3)
    for _ in range(5):
        env.step(actions(env))
    assert evaluate_skills(env, act, duration=1.4, command=0.3) == first


def test_rsl_rl_trains_its_own_ppo_on_it(env):
    network = {"class_name": "MLPModel", "hidden_dims": [16], "activation": "elu"}
    distribution = {"class_name": "GaussianDistribution", "init_std": 0.5, "std_type": "log"}
    config = {
        "num_steps_per_env": 4,
        "save_interval": 100,
        "obs_groups": {"actor": [names.PROPRIO], "critic": [names.CRITIC]},
        "actor": network | {"distribution_cfg": distribution},
        "critic": network,
        "algorithm": {"class_name": "PPO", "num_learning_epochs": 2, "num_mini_batches": 2},
    }
    runner = OnPolicyRunner(env, config, log_dir=None, device="cpu")
    before = [p.detach().clone() for p in runner.alg.actor.parameters()]
    runner.learn(2)
    after = list(runner.alg.actor.parameters())
    assert all(p.isfinite().all() for p in after)
    assert not any(torch.equal(a, b) for a, b in zip(before, after, strict=True))


def test_the_paper_s_rewards_build_and_step(build_env):
    env = build_env(cfg="paper")
    for _ in range(10):
        _, rewards, _, extras = env.step(actions(env))
    assert rewards.isfinite().all()
    terms = [key for key in extras["log"] if key.startswith("Reward/")]
    assert len(terms) == 14  # the table, without the residual of the second phase
    assert rewards.abs().max() < 0.3  # times the step duration


@pytest.mark.parametrize(
    ("backend", "device", "expected"),
    [("auto", "cpu", "native"), ("auto", "cuda", "warp"), ("warp", "cpu", "warp")],
)
def test_the_device_chooses_the_backend(backend, device, expected):
    assert resolve_backend(backend, torch.device(device)) == expected


def test_a_backend_that_cannot_be_is_refused():
    with pytest.raises(ConfigError, match=r"sim.backend=bullet: allowed are auto, native, warp"):
        resolve_backend("bullet", torch.device("cpu"))
    with pytest.raises(ConfigError, match=r"sim.backend=native runs on the CPU"):
        resolve_backend("native", torch.device("cuda"))
