"""The worked examples of docs/extending.md, applied to a copy of the project and run there."""

from __future__ import annotations

import importlib
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

ROOT = Path(__file__).parent.parent
MAPPED = ("envs", "robots", "cfg", "tools")  # imported as kiras_rl.<folder>
PAGE = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
SECTIONS = re.findall(r"^## (.+)$", PAGE, re.MULTILINE)
DIFFS = re.findall(r"^```diff\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)

pytestmark = pytest.mark.skipif(shutil.which("git") is None, reason="needs git to apply diffs")


def copy_project(folder: Path) -> None:
    """Copy what is installed; links stand for the package map of pyproject.toml."""
    for name in ("kiras_rl", *MAPPED):
        ignored = shutil.ignore_patterns("__pycache__", *MAPPED)
        shutil.copytree(ROOT / name, folder / name, ignore=ignored)
    for name in MAPPED:
        (folder / "kiras_rl" / name).symlink_to(folder / name)


def forget_the_package(folder: Path) -> dict:
    """Take kiras_rl and the user's files out of what Python has loaded, and return that."""
    ours = {"kiras_rl", *(path.stem for path in folder.glob("*.py"))}
    names = [name for name in sys.modules if name.split(".")[0] in ours]
    return {name: sys.modules.pop(name) for name in names}


@pytest.fixture(scope="module", autouse=True)
def extended(tmp_path_factory):
    """Apply every diff of the page; in this module `import kiras_rl` means the copy."""
    folder = tmp_path_factory.mktemp("extended")
    copy_project(folder)
    command = ["git", "apply"]
    subprocess.run(command, input="".join(DIFFS), cwd=folder, text=True, check=True)
    original = forget_the_package(folder)
    sys.path.insert(0, str(folder))
    importlib.invalidate_caches()
    yield folder
    sys.path.remove(str(folder))
    forget_the_package(folder)
    sys.modules.update(original)


def make_env(name: str, *overrides: str):
    from kiras_rl.config import load_config
    from kiras_rl.envs import make_env

    config = load_config(name, ["num_envs=4", *overrides])
    return make_env(config), config


def test_there_is_one_diff_an_example(extended):
    import kiras_rl

    assert len(DIFFS) == len(SECTIONS)
    assert Path(kiras_rl.__file__).is_relative_to(extended)


def test_the_table_counts_the_files_of_every_example():
    rows = re.findall(r"^\| \[(.+?)\]\(#.+?\) \| (\d+) \|", PAGE, re.MULTILINE)
    counted = zip(SECTIONS, (diff.count("diff --git") for diff in DIFFS), strict=True)
    assert [(name, int(files)) for name, files in rows] == [(s.lower(), n) for s, n in counted]


def test_a_skill_is_one_line():
    from kiras_rl.robots.robot import load_robot
    from kiras_rl.robots.statics import check_keyframe

    robot = load_robot("solo8")
    keyframe = robot.keyframe("low_walk")
    assert robot.skills.index("low_walk") == 5
    # two links of 0.16 m, hip 0.15 - 0.016 m above the centre of the foot
    thigh = np.arccos(0.134 / 2 / 0.16)
    front, hind = [thigh, -2 * thigh], [-thigh, 2 * thigh]  # knees inward
    np.testing.assert_allclose(keyframe.joint_pos, 2 * front + 2 * hind, atol=1e-3)
    check_keyframe(robot, keyframe)
    env, _ = make_env("solo8_quick")
    assert env.get_observations()["skill"].shape == (4, 6)
    assert env.keyframe_features.shape[0] == 6


def test_a_reward_is_a_function_and_a_line():
    env, _ = make_env("solo8_thrifty")
    log = env.step(torch.randn(4, 8))[3]["log"]
    power = (env.robot.joint_torque * env.robot.joint_vel).abs().sum(-1)
    assert power.max() > 0.1  # W
    torch.testing.assert_close(log["Reward/joint_power"], -0.005 * power.mean())


def test_a_reward_may_remember_what_it_needs():
    env, _ = make_env("solo8_soft", "env.commands.zero_probability=0")
    falling, in_air, landed = torch.zeros(4, 4), torch.zeros(4, 4) > 0, 0
    for _ in range(40):
        _, _, dones, extras = env.step(1.5 * torch.randn(4, 8))
        stands = env.measure().foot_stands
        landing = stands & in_air
        expected = -0.2 * (falling * landing).sum(1).mean()
        torch.testing.assert_close(extras["log"]["Reward/landing_speed"], expected)
        landed += landing.sum()
        speed = (-env.robot.foot_vel_w[..., 2]).clamp(min=0.0)
        falling = torch.where(stands | dones[:, None], 0.0, speed)
        in_air = ~stands & ~dones[:, None]
    assert landed > 5


def test_a_termination_is_a_function_of_ones_own_and_a_line():
    env, _ = make_env("solo8_knees", "env.terminations.random_first_length=false")
    fell = 0
    for _ in range(30):
        _, _, dones, extras = env.step(6 * torch.randn(4, 8))
        kneels = (env.robot.limb_force > 20.0).any(1)
        assert extras["log"]["Episode/ended_by_knees"] == kneels.sum()
        assert dones[kneels].all()
        fell += kneels.sum()
    assert fell > 0


def test_a_constraint_is_a_function_of_ones_own_and_a_line():
    env, _ = make_env("solo8_high")
    assert env.constraints == ("low",)
    for _ in range(10):
        extras = env.step(6 * torch.randn(4, 8))[3]
    below = (0.12 - env.measure().base_height).clamp(min=0.0)
    torch.testing.assert_close(extras["constraints"], below[:, None])


def test_an_observation_reaches_the_robot(tmp_path):
    from kiras_rl.checkpoint import load_policy
    from kiras_rl.deploy.policy import OnboardPolicy
    from kiras_rl.export import export_policy
    from kiras_rl.phases import plan
    from kiras_rl.runner import KirasRunner

    env, config = make_env("solo8_roll")
    for _ in range(3):
        obs, *_ = env.step(5 * torch.randn(4, 8))  # tumbling
    KirasRunner(env, plan(config)[0], None, "cpu").save(str(tmp_path / "run.pt"))
    policy = OnboardPolicy(
        export_policy(*load_policy(tmp_path / "run.pt"), tmp_path / "p.onnx").path
    )
    assert [term.name for term in policy.metadata.observation][-1] == "roll"

    rest = np.zeros(8)
    policy.reset(rest)
    policy.step(rest, rest, (np.cos(0.15), np.sin(0.15), 0, 0), rest[:3], rest[:3], "low_walk")
    assert policy.frame[-1] == pytest.approx(2.0 * 0.3)  # scale 2, rolled by 0.3 rad
    policy.step(rest, rest, env.sim.qpos[0, 3:7].numpy(), rest[:3], rest[:3], "low_walk")
    seen = obs["proprio"][0, -1].item()
    assert abs(seen) > 1e-3
    assert policy.frame[-1] == pytest.approx(seen, abs=1e-5)


def test_a_randomization_is_a_function_of_ones_own_and_a_line():
    env, _ = make_env("solo8_soft_ground")
    constant = env.sim.state_dict()["field/geom_solref"][..., 0]
    assert len(constant.unique()) == 4  # one a world
    assert 0.02 <= constant.min() < constant.max() < 0.06
    plain, _ = make_env("solo8_quick")
    assert "field/geom_solref" not in plain.sim.state_dict()


def test_a_command_is_a_function_of_ones_own_and_its_lines():
    env, _ = make_env("solo8_heights")
    for _ in range(5):
        asked = env.task.terms["height"]
        obs, _, _, extras = env.step(torch.randn(4, 8))
        error = env.measure().base_height - asked[:, 0]
        paid = 0.5 * torch.exp(-((error / 0.02) ** 2)).mean()
        torch.testing.assert_close(extras["log"]["Reward/height"], paid)
        torch.testing.assert_close(obs["critic"][:, -1:], 10.0 * env.task.terms["height"])


def test_a_robot_is_a_folder():
    from kiras_rl.robots.robot import list_robots, load_robot
    from kiras_rl.robots.statics import check_keyframe

    assert "mite" in list_robots()
    robot = load_robot("mite")
    for keyframe in robot.keyframes:
        check_keyframe(robot, keyframe)
    # two links of 0.12 m, hip 0.18 - 0.015 m above the centre of the foot
    assert robot.default_joint_pos[0] == pytest.approx(np.arccos(0.165 / 2 / 0.12), abs=1e-3)
    env, _ = make_env("solo8_quick", "robot=mite")
    for _ in range(50):  # with no action it holds its default pose, the walk keyframe
        env.step(torch.zeros(4, 8))
    assert env.skills == ("walk", "crawl", "pitch_up")
    assert env.measure().foot_contact.all()
    torch.testing.assert_close(
        env.measure().base_height, torch.full((4,), 0.18), atol=0.01, rtol=0.0
    )


def test_a_terrain_is_a_function_and_a_line():
    from kiras_rl.config import load_config
    from kiras_rl.envs.ground import Ground
    from kiras_rl.envs.terrain_library import build_library
    from kiras_rl.phases import FINETUNING, phase_of

    config = load_config("solo8_waves", ["finetuning.env.terrain.noise=[0,0]"])
    library = build_library(phase_of(config, FINETUNING).config.env.terrain)
    ground = Ground(library, 1, torch.device("cpu"))
    ground.tile[:] = library.index(library.types.index("waves"), 9, 0)
    x = torch.tensor([0.6, 1.0, 1.4])  # trough, crest and trough of a wave 0.8 m long
    heights = ground.heights(torch.stack([x, torch.zeros(3)], dim=1)[None])[0]
    torch.testing.assert_close(heights, torch.tensor([0.0, 0.15, 0.0]), atol=6e-3, rtol=0.0)


def test_a_part_of_the_learner_is_a_class_and_a_line():
    from kiras_rl.algorithms.kiras import KirasPPO
    from kiras_rl.phases import plan

    env, config = make_env("solo8_bounded")
    settings = plan(config)[0].learner_settings(env.step_dt)
    alg = KirasPPO.construct_algorithm(env.get_observations(), env, settings, "cpu")
    mean = torch.tensor([[5.0, -8.0], [0.0, 5.5]])
    loss = alg.parts["bounds"].policy_loss(mean, {})
    assert loss == pytest.approx(0.01 * (9.0 + 0.25) / 2)


def test_an_ablation_is_a_file():
    from kiras_rl.config import list_configs, load_config
    from kiras_rl.imitation.premium import PremiumSelector

    assert "ablations/keyframes_only" in list_configs()
    premium = load_config("ablations/keyframes_only").learner.imitation.premium
    assert premium.keyframe_share == 1.0
    keyframes = torch.tensor([[1.0, 2.0]])
    selector = PremiumSelector(premium, keyframes, num_envs=1, num_steps=24)
    selector.scores[0, 0] = 9.0  # a premium trajectory, which must not be drawn
    drawn = selector.sample(torch.zeros(100, dtype=torch.int64))
    assert (drawn == torch.tensor([1.0, 2.0, 1.0, 2.0])).all()
