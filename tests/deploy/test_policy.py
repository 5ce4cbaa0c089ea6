"""The policy on the robot: the observation of training, rebuilt by hand; errors; no torch."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import onnx
import pytest
import torch

from kiras_rl.deploy.policy import OnboardPolicy, PolicyError
from kiras_rl.export import export_policy

DEFAULT = np.array([0.8, -1.6] * 2 + [-0.8, 1.6] * 2)
CRAWL = DEFAULT + np.array([0.5, -1.0] * 4)
LEVEL = (1.0, 0.0, 0.0, 0.0)


def step(policy, **changes):
    """Run one step of a robot that stands level at the default pose, but for the changes."""
    reading = {
        "joint_pos": DEFAULT,
        "joint_vel": np.zeros(8),
        "imu_quat": LEVEL,
        "base_ang_vel": np.zeros(3),
        "command": np.zeros(3),
        "skill": "walk",
    }
    return policy.step(**(reading | changes))


@pytest.fixture
def policy(exported):
    return OnboardPolicy(exported[2])


def test_every_term_of_a_frame(policy):
    """Each block is the reading times the scale of its term, in the order of the metadata."""
    policy.reset(CRAWL)
    angle = 0.3  # nose down
    step(
        policy,
        joint_pos=DEFAULT + np.arange(8) / 10,
        joint_vel=np.arange(8),
        imu_quat=(np.cos(angle / 2), 0, np.sin(angle / 2), 0),
        base_ang_vel=(1, 2, 3),
        command=(0.3, 0.2, 0.1),
        skill="stilt",
    )
    expected = [
        *(np.sin(angle), 0, -np.cos(angle)),  # gravity leans towards the nose
        3.0 * angle,
        *(0.25, 0.5, 0.75),
        2.0 * 0.3,
        4.0 * 0.2,
        0.5 * 0.1,
        *(0, 0, 1, 0, 0),
        *(1.5 * np.arange(8) / 10),
        *(0.05 * np.arange(8)),
        *(0.1 * np.array([1.0, -2.0] * 4)),  # (crawl - default) / 0.5, the action that holds it
    ]
    np.testing.assert_allclose(policy.frame, expected, atol=1e-6)


def test_gravity_sees_roll_and_pitch_and_no_heading(policy):
    """Left side down by 90 degrees: gravity points to the left; a heading changes nothing."""
    half = np.sqrt(0.5)
    step(policy, imu_quat=(half, -half, 0, 0))
    np.testing.assert_allclose(policy.frame[:3], (0, 1, 0), atol=1e-6)
    step(policy, imu_quat=(half, 0, 0, half))
    np.testing.assert_allclose(policy.frame[:3], (0, 0, -1), atol=1e-6)


def test_history_starts_as_copies_and_then_holds_the_past_oldest_first(policy):
    policy.reset(DEFAULT)
    frames = []
    for k in range(6):
        step(policy, command=(k / 10, 0, 0))
        frames.append(policy.frame)
        past = [frames[0]] * 4 + frames[:-1]
        np.testing.assert_array_equal(policy.history, past[-4:])


def test_reset_forgets_history_and_action(policy):
    policy.reset(DEFAULT)
    first = step(policy)
    for _ in range(5):
        step(policy, joint_vel=np.full(8, 2.0))
    policy.reset(DEFAULT)
    np.testing.assert_array_equal(step(policy), first)
    np.testing.assert_array_equal(policy.history, [policy.frame] * 4)


def test_the_action_goes_into_the_next_frame(policy):
    step(policy)
    action = policy.action
    step(policy)
    np.testing.assert_allclose(policy.frame[-8:], 0.1 * action, atol=1e-6)


def test_the_target_is_default_plus_scaled_action(policy):
    target = step(policy)
    np.testing.assert_allclose(target, DEFAULT + 0.5 * policy.action)


def test_targets_are_clipped_to_the_joint_limits(make_metadata, make_policy, tmp_path):
    metadata = make_metadata(joint_limits=[[-0.9, 0.85], [-1.7, 1.7]] * 4)
    networks = make_policy(metadata, gain=10.0)  # actions far beyond
    export_policy(networks, metadata, tmp_path / "a.onnx")
    target = step(OnboardPolicy(tmp_path / "a.onnx"))
    low, high = np.array(metadata.joint_limits).T
    assert (target >= low).all() and (target <= high).all()
    assert ((target == low) | (target == high)).any()


def test_actions_are_clipped(make_metadata, make_policy, tmp_path):
    metadata = make_metadata(action_clip=0.25)
    networks = make_policy(metadata)
    torch.nn.init.constant_(networks.actor[-1].bias, 100.0)
    export_policy(networks, metadata, tmp_path / "a.onnx")
    policy = OnboardPolicy(tmp_path / "a.onnx")
    np.testing.assert_allclose(step(policy), DEFAULT + 0.5 * 0.25)
    step(policy)
    np.testing.assert_allclose(policy.frame[-8:], 0.1 * 0.25, rtol=1e-6)


def test_a_skill_by_name_and_by_index_is_the_same(exported):
    policies = [OnboardPolicy(exported[2]) for _ in range(2)]
    targets = [step(policy, skill=s) for policy, s in zip(policies, ("crawl", 1), strict=True)]
    np.testing.assert_array_equal(*targets)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"skill": "crwl"}, r"unknown skill 'crwl' \(did you mean 'crawl'\?\); .*: walk, crawl,"),
        ({"skill": 5}, "unknown skill '5'; this policy has: walk"),
        ({"skill": -1}, "unknown skill '-1'"),
        ({"joint_pos": np.zeros(12)}, r"joint_pos has shape \(12,\), expected \(8,\) for solo8"),
        ({"command": (0.3, 0)}, r"command has shape \(2,\), expected \(3,\)"),
        ({"joint_vel": np.full(8, np.nan)}, "joint_vel is not finite"),
        ({"joint_vel": np.full(8, 1e39)}, "joint_vel is beyond 1000"),
        ({"joint_pos": [0.0, [1.0]] * 4}, "joint_pos is no list of numbers"),
        ({"imu_quat": (0, 0, 0, 0)}, "imu_quat is not a rotation"),
        ({"imu_quat": (9, 9, 9, 9)}, "imu_quat is not a rotation"),
        ({"skill": None}, "unknown skill 'None'"),
        ({"skill": 1.7}, "unknown skill '1.7'"),
        ({"skill": np.array([1, 2])}, "unknown skill"),
    ],
)
def test_a_wrong_reading_is_named_and_leaves_no_trace(policy, changes, message):
    step(policy)
    before = [x.copy() for x in (policy.frame, policy.history, policy.action)]
    with pytest.raises(PolicyError, match=message):
        step(policy, **changes)
    for mine, its in zip((policy.frame, policy.history, policy.action), before, strict=True):
        np.testing.assert_array_equal(mine, its)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(PolicyError, match=r"no policy file at .*gone\.onnx"):
        OnboardPolicy(tmp_path / "gone.onnx")


def test_another_kind_of_file_is_named(tmp_path):
    (tmp_path / "a.onnx").write_text("a letter")
    with pytest.raises(PolicyError, match="is not an ONNX file that can be run"):
        OnboardPolicy(tmp_path / "a.onnx")


def test_a_foreign_onnx_file_is_named(exported, tmp_path):
    model = onnx.load(exported[2])
    del model.metadata_props[:]
    onnx.save(model, tmp_path / "a.onnx")
    with pytest.raises(PolicyError, match="not a kiras policy: it lacks the metadata entry"):
        OnboardPolicy(tmp_path / "a.onnx")


def test_a_network_that_does_not_fit_its_metadata_is_named(exported, make_metadata, tmp_path):
    model = onnx.load(exported[2])
    model.metadata_props[0].value = make_metadata(history_length=3).to_json()
    onnx.save(model, tmp_path / "a.onnx")
    with pytest.raises(PolicyError, match=r"its metadata ask for .*'history': 117"):
        OnboardPolicy(tmp_path / "a.onnx")


CLOSED_LOOP = """
import sys
for name in ("torch", "rsl_rl", "tensordict", "onnx"):
    sys.modules[name] = None  # importing it raises ImportError
import numpy as np
from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.tools.driving.driver import Driver

policy = OnboardPolicy(sys.argv[1])
driver = Driver(policy)
driver.set_task("crawl", (0.3, 0.0, 0.1))
rows = []
for _ in range(50):
    driver.step()
    joints = driver.data.qpos[7:].copy()
    rows.append((policy.frame, policy.history, policy.action, policy.velocity, joints))
frames, histories, actions, velocities, joints = map(np.array, zip(*rows))
np.savez(sys.argv[2], frames=frames, histories=histories, actions=actions,
         velocities=velocities, joints=joints)
"""


def test_a_second_in_closed_loop_without_torch_gives_the_actions_of_torch(exported, tmp_path):
    policy, _, path = exported
    out = tmp_path / "loop.npz"
    subprocess.run([sys.executable, "-c", CLOSED_LOOP, path, out], check=True)
    loop = np.load(out)
    with torch.no_grad():
        actions, velocities = policy(
            torch.from_numpy(loop["frames"]), torch.from_numpy(loop["histories"]).reshape(50, -1)
        )
    assert np.ptp(loop["joints"], axis=0).min() > 0.05  # the legs moved: a loop, not a pose
    np.testing.assert_allclose(loop["actions"], actions.clamp(-6, 6), atol=1e-4)
    np.testing.assert_allclose(loop["velocities"], velocities, atol=1e-4)
