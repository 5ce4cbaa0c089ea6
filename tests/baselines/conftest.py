"""Small trainings of the baselines."""

from __future__ import annotations

import pytest

from kiras_rl.config import load_config
from kiras_rl.envs import make_env
from kiras_rl.phases import SKILL_LEARNING, phase_of
from kiras_rl.runner import KirasRunner

TINY = (
    *("num_envs=16", "iterations=4", "device=cpu", "sim.backend=native", "evaluation.interval=0"),
    "env.terminations.episode_length=0.5",
    *("finetuning.iterations=2", "finetuning.env.terrain.levels=2"),
    "finetuning.env.terrain.variants=2",
)

SMALL = {
    "dreamwaq": (),
    "cat": (),
    "wtw": (),
    "cassi": ("learner.parts.cassi.batch_size=64", "learner.parts.cassi.updates=2"),
}


@pytest.fixture
def make_runner(tmp_path):
    """Return a function that builds a run from its configuration: what a new process does."""

    def make(cfg, run, *overrides, phase=SKILL_LEARNING):
        config = load_config(f"baselines/{cfg}", [*TINY, *SMALL[cfg], *overrides])
        resolved = phase_of(config, phase)
        env = make_env(resolved.config)
        return KirasRunner(env, resolved, tmp_path / run, "cpu")

    return make
