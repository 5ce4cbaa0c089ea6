"""What each rank of test_ranks.py does, started by torchrun with a folder for the results."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path
from unittest.mock import patch

import torch

from kiras_rl import distributed, process
from kiras_rl import interfaces as names
from kiras_rl.config import load_config
from kiras_rl.phases import FINETUNING, SKILL_LEARNING, phase_of, plan
from kiras_rl.runner import KirasRunner
from kiras_rl.tools.train import main
from kiras_rl.tools.training.run import build

WORLDS, STEPS = 4, 24  # of each rank

# One gradient step of every network, on all samples; experts rest in their keyframes.
ONE_STEP = (
    "evaluation.interval=0",
    "learner.ppo.num_epochs=1",
    "learner.ppo.num_mini_batches=1",
    "learner.estimator.adaboot=off",
    "learner.imitation.discriminator.updates=1",
    "learner.precision=float32",  # gradients are compared to 1e-5
    "learner.imitation.premium.keyframe_share=1",
)

# Both phases; who is asked for 3 m/s is judged after 2 s.
SHORT = ("evaluation.terrain.command=[3,3]", "evaluation.duration=1.1")

# Episodes and premium windows end many times, and AdaBoot decides.
EVENTFUL = (
    "iterations=4",
    "finetuning=null",
    "env.terminations.episode_length=0.5",
    "learner.estimator.adaboot=both",
    "learner.imitation.premium.window=24",
    "learner.imitation.premium.capacity=6",
    "learner.imitation.premium.min_command=0",
    "learner.imitation.premium.min_progress=0",
    "learner.imitation.premium.max_distance=100",
)


# --- gradients -----------------------------------------------------------------------------------


def make_runner(num_envs: int, phase: str) -> KirasRunner:
    batch = f"learner.imitation.discriminator.batch_size={num_envs * STEPS}"
    overrides = [f"num_envs={num_envs}", batch, *ONE_STEP]
    return build(phase_of(load_config("smoke", overrides), phase), None)


def collect(phase: str) -> dict:
    """Return a rollout of the worlds of both ranks, with masks that differ between the ranks."""
    runner = make_runner(2 * WORLDS, phase)
    runner._rollout()
    alg, world = runner.alg, torch.arange(2 * WORLDS)
    st = alg.storage
    st.dones[::5, :3] = 1
    st.task_rewards += st.actions.sum(dim=-1, keepdim=True)  # advantages that gradients tell
    if "retention" in alg.parts:
        st.observations[names.FLAT_ACTION] += torch.randn(STEPS, 2 * WORLDS, 8)  # else no loss
        st.observations[names.IS_FLAT] = (world < 2).expand(STEPS, -1).unsqueeze(-1)
    if imitation := alg.parts.get("imitation"):
        imitation._valid[:] = world % 3 > 0
    return {
        "storage": {
            k: v.clone() for k, v in vars(st).items() if isinstance(v, torch.Tensor) and v.dim() > 1
        },
        "observations": st.observations.clone(),
        "last": runner.env.get_observations(),
        "imitation": _pairs(imitation) if imitation else {},
    }


def _pairs(imitation) -> dict:
    return {name: getattr(imitation, name) for name in ("_pairs", "_valid", "_rewards")}


def gradients(phase: str, rollout: dict, worlds: slice) -> dict[str, torch.Tensor]:
    """Train a new learner on some worlds of a rollout; return the gradients of every network."""
    runner = make_runner(worlds.stop - worlds.start, phase)
    alg, mine = runner.alg, (slice(None), worlds)
    for name, value in rollout["storage"].items():
        setattr(alg.storage, name, value[mine].clone())
    alg.storage.observations = rollout["observations"][mine].clone()
    for name, value in rollout["imitation"].items():
        setattr(alg.parts["imitation"], name, value[mine].clone())
    with torch.no_grad():
        alg.compute_returns(rollout["last"][worlds])
    with drawn_alike():
        alg.update()
    networks = {"actor": alg.actor, "critics": alg.critic}
    for name in {"estimator", "imitation"} & alg.parts.keys():
        networks |= alg.parts[name].networks()
    return {
        name: torch.cat([p.grad.flatten() for p in network.parameters() if p.grad is not None])
        for name, network in networks.items()
    }


def drawn_alike():
    """Give every sample the same random numbers, in whichever batch it is."""
    return patch.multiple(
        torch,
        rand=lambda *size, device=None: torch.full(size, 0.5),
        randn=lambda *size, device=None: torch.zeros(size),
        randn_like=torch.zeros_like,
        randint=lambda high, size, device=None: torch.arange(high),
    )


# --- trainings -----------------------------------------------------------------------------------


def eventful(folder: str, *overrides: str) -> KirasRunner:
    """Build what a new process would."""
    config = load_config("smoke", [*EVENTFUL, *overrides])
    return build(plan(config)[0], Path(folder).absolute())


def state_of(runner: KirasRunner) -> dict:
    return {
        "learner": runner.alg.save(),
        "env": runner.env.state_dict(),
        "generators": process.generator_states(),
    }


def train_whole_and_in_parts() -> tuple[dict, dict]:
    whole = eventful("whole")
    whole.learn()
    expected = state_of(whole)
    first = eventful("parts")
    first.learn(2)
    second = eventful("parts", "seed=77")
    second.load(str(first.run_dir / "checkpoints" / "latest.pt"))
    second.learn()
    return expected, state_of(second)


def stop_from_rank_1() -> int:
    """Return after how many iterations a signal to the second rank stops this one."""
    runner = eventful("stopped", "iterations=50", "evaluation.interval=0")

    def interrupt(status):
        if distributed.rank() == 1 and status.iteration == 2:
            signal.raise_signal(signal.SIGTERM)

    runner.learn(on_iteration=interrupt)
    return runner.current_learning_iteration


def break_rank_1() -> str:
    """Return what each rank says of a value that is not finite on the second."""
    runner = eventful("broken")
    obs = runner.env.get_observations()
    if distributed.rank() == 1:
        obs["critic"][0, 0] = torch.nan
    try:
        with patch.object(runner.env, "get_observations", return_value=obs):
            runner.learn(1)
    except ValueError as error:
        return str(error)
    return ""


def train_alone() -> dict[str, tuple[dict, dict]]:
    """Return rollouts of all worlds and the gradients of one process, of both phases."""
    results = {}
    for phase in (SKILL_LEARNING, FINETUNING):
        rollout = collect(phase)
        results[phase] = (rollout, gradients(phase, rollout, slice(0, 2 * WORLDS)))
    return results


def work(out: Path) -> None:
    alone = train_alone() if os.environ["RANK"] == "0" else {}
    home = out / f"rank_{os.environ['RANK']}"
    home.mkdir()
    os.chdir(home)
    with distributed.group():
        assert main(["--cfg", "smoke", "--runs", "runs", *SHORT]) == 0
        assert main(["--sweep", "ablations", "--runs", "runs"]) == 2
        begin = WORLDS * distributed.rank()
        results = {
            "gradients": {
                phase: (expected, gradients(phase, rollout, slice(begin, begin + WORLDS)))
                for phase, (rollout, expected) in distributed.from_main(lambda: alone).items()
            }
        }
        results["whole"], results["parts"] = train_whole_and_in_parts()
        results["stopped"] = stop_from_rank_1()
        results["broken"] = break_rank_1()
        results["threads"] = torch.get_num_threads()
    results["files"] = [str(path) for path in Path().rglob("*") if path.is_file()]
    torch.save(results, out / f"results_{os.environ['RANK']}.pt")


if __name__ == "__main__":
    work(Path(sys.argv[1]))
