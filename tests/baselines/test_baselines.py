"""What every baseline has to do: train both phases, resume exactly, export, and compare fairly."""

from __future__ import annotations

import pytest
import torch
import yaml
from states import differences

from kiras_rl.algorithms.trainer import Trainer
from kiras_rl.checkpoint import find_checkpoint, load_checkpoint, load_policy
from kiras_rl.config import CFG_FOLDER, config_to_dict, load_config, read_keys
from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.export import MAX_BYTES, export_policy
from kiras_rl.phases import FINETUNING
from kiras_rl.tools.train import main

BASELINES = ("dreamwaq", "cassi", "cat", "wtw")

SMALL = {"dreamwaq": {}, "cat": {}, "wtw": {}, "cassi": {"parts": {"cassi": {"batch_size": 64}}}}
"""Changes of the learner that make the smallest training smaller."""

MAY_DIFFER = (
    *("env.rewards.terms.skill_height", "env.rewards.terms.skill_orientation"),
    *("learner.imitation", "learner.multi_critic", "learner.estimator", "learner.skill_init"),
    *("learner.parts", "finetuning.learner.parts"),
)
"""What makes a baseline another method; everything else is that of KiRAS."""

UNLABELLED = (
    "env.observations.imitation",
    *("env.skills.start_at_target", "finetuning.env.terrain.task.start_at_target"),
    "finetuning.env.rewards.terms.skill_height",
    "finetuning.env.rewards.terms.skill_orientation",
)
"""What else a method may not be told to whom a skill is a latent."""

BOUNDED = (
    "torque_limits",
    "joint_acceleration",
    "action_rate",
    "hard_landing",
    "collision",
    "short_swing",
    "stand_still",
    "flight",
    "termination",
)
"""Rewards whose place constraints take, on flat ground."""

SCHEDULED = (
    *("contact_force", "contact_velocity", "swing_height", "body_height", "body_orientation"),
    *("short_swing", "short_stance", "low_swing", "idle_feet", "flight"),
)
"""Rewards of the gait that a clock sets, and those whose place they take."""

OWN = {
    "dreamwaq": (),
    "cassi": UNLABELLED,
    "cat": (
        "env.constraints",
        *(f"env.rewards.terms.{name}" for name in BOUNDED),
        *(f"finetuning.env.rewards.terms.{name}" for name in ("torque_limits", "limb_load")),
    ),
    "wtw": (
        "env.commands.terms",
        *(f"env.observations.proprio.{name}" for name in ("clock_signal", "behaviour")),
        *(f"env.observations.critic.{name}" for name in ("friction", "payload")),
        "env.rewards.sigma",
        *(f"env.rewards.terms.{name}" for name in SCHEDULED),
        *(f"finetuning.env.rewards.terms.skill_{name}" for name in ("height", "orientation")),
    ),
}
"""What else differs, by baseline."""


@pytest.fixture
def smoke(tmp_path):
    """Return a function that writes a baseline's configuration at the size of cfg/smoke.yaml."""

    def write(cfg):
        values = read_keys(CFG_FOLDER / "smoke.yaml") | {"extends": f"baselines/{cfg}"}
        values["learner"] = SMALL[cfg]  # there it is of a part that no baseline has
        path = tmp_path / "smoke.yaml"
        path.write_text(yaml.safe_dump(values), encoding="utf-8")
        return path

    return write


def latest(runner):
    return runner.run_dir / "checkpoints" / "latest.pt"


@pytest.mark.parametrize("cfg", BASELINES)
def test_it_trains_both_phases_into_a_policy_file(cfg, smoke, tmp_path):
    torch.set_num_threads(1)
    assert main(["--cfg", str(smoke(cfg)), "--runs", str(tmp_path / "runs")]) == 0
    torch.set_num_threads(2)
    (run,) = (tmp_path / "runs" / "smoke").iterdir()
    policy, description = load_policy(find_checkpoint(run))
    report = export_policy(policy, description, tmp_path / "again.onnx")
    assert report.max_difference < 1e-4
    assert report.size < MAX_BYTES == 500_000
    onboard = OnboardPolicy(run / "policy.onnx")
    assert onboard.metadata.skills == ("walk", "crawl", "stilt", "pitch_up", "pitch_down")


@pytest.mark.parametrize("cfg", BASELINES)
def test_a_training_resumed_in_both_phases_ends_with_the_same_bits(cfg, make_runner):
    def finetune(run, stop):
        rough = make_runner(cfg, run, phase=FINETUNING)
        rough.begin_from(latest(rough))
        if stop:
            rough.learn(1)
            rough = make_runner(cfg, run, "seed=77", phase=FINETUNING)
            rough.load(str(latest(rough)))
        assert rough.learn()
        return load_checkpoint(latest(rough))

    whole = make_runner(cfg, "whole")
    assert whole.learn()
    first = make_runner(cfg, "parts")
    first.learn(2)
    second = make_runner(cfg, "parts", "seed=77")
    second.load(str(latest(first)))
    assert second.learn()
    pairs = [[load_checkpoint(latest(runner)) for runner in (whole, second)]]
    pairs.append([finetune(run, stop) for run, stop in (("whole", False), ("parts", True))])
    for one, other in pairs:
        for part in ("learner", "env", "generators", "policy"):
            assert differences(one[part], other[part], part) == []


@pytest.mark.parametrize("cfg", BASELINES)
def test_replayed_rollouts_and_updates_are_the_same(cfg, make_runner, taped):
    def train(recorded):
        torch.manual_seed(2)
        runner = make_runner(cfg, str(recorded), "learner.ppo.num_steps=6")
        parts = runner.alg.parts.values()
        trainers = [x for part in parts for x in vars(part).values() if isinstance(x, Trainer)]
        graphs = [runner.alg._rollout._act, runner.alg._rollout._store]
        graphs += [trainer._pass for trainer in (runner.alg.trainer, *trainers)]
        for graph in graphs:
            graph.records = recorded
        runner.learn(3)
        assert all((graph._recording is not None) == recorded for graph in graphs)
        return runner.alg.save()

    assert differences(train(False), train(True)) == []


@pytest.mark.parametrize("cfg", BASELINES)
def test_only_the_method_differs_from_kiras(cfg):
    kiras, baseline = (flat(load_config(name)) for name in ("solo8", f"baselines/{cfg}"))
    changed = {key for key in kiras | baseline if kiras.get(key) != baseline.get(key)}
    may_differ = MAY_DIFFER + OWN[cfg]
    assert changed
    assert [key for key in sorted(changed) if not key.startswith(may_differ)] == []


def flat(config):
    """Return the leaves of a configuration by their dotted keys."""

    def walk(values, prefix):
        for name, value in values.items():
            if isinstance(value, dict) and value:
                yield from walk(value, f"{prefix}{name}.")
            else:
                yield f"{prefix}{name}", value

    return dict(walk(config_to_dict(config), ""))
