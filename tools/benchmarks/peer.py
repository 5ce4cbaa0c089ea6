"""Our environment beside mjlab's, which runs in another Python environment, in turns."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from tempfile import TemporaryFile
from typing import Any

import torch
from rich.table import Table

from kiras_rl.checkpoint import versions
from kiras_rl.config import ConfigError, load_config
from kiras_rl.envs import make_env
from kiras_rl.process import single_threaded
from kiras_rl.tools.benchmarks.request import Figures, Request
from kiras_rl.tools.benchmarks.tables import make_table, with_range
from kiras_rl.tools.benchmarks.timing import interleave, ratios, summarise
from kiras_rl.tools.benchmarks.workload import timed_steps

OURS, PEER = "KiRAS-RL", "mjlab"
STEPS = 50  # control steps of a round

_SCRIPT = Path(__file__).parent / "peer_mjlab.py"


def measure(request: Request) -> Figures:
    """Step both environments under zero actions: a Go1 on flat ground at 50 Hz, commands followed.

    Raises:
        ConfigError: mjlab cannot be run by the interpreter that was given.
    """
    config = load_config("go1", [f"num_envs={request.config.num_envs}"])
    env = make_env(config, request.device)
    actions = torch.zeros(env.num_envs, env.num_actions, device=request.device)
    ours = timed_steps(lambda: None, lambda _: env.step(actions), STEPS, env.device)
    with single_threaded(request.device), _peer(request) as (about, theirs):
        times = interleave({OURS: ours, PEER: theirs}, request.rounds)
    return {
        "worlds": env.num_envs,
        "device": request.device,
        "steps": STEPS,
        "task": {OURS: "go1, flat ground", PEER: about["task"]},
        "versions": {OURS: versions(), PEER: about["versions"]},
        "seconds_per_step": {name: summarise(seconds) for name, seconds in times.items()},
        "steps_per_second": {n: env.num_envs / median(seconds) for n, seconds in times.items()},
        "times_as_fast": {name: summarise(ratios(times, PEER, name)) for name in times},
        "rounds": times,
    }


@contextmanager
def _peer(request: Request) -> Iterator[tuple[dict, Callable[[], float]]]:
    """Yield what mjlab says of itself, and a function that returns the seconds of its step."""
    numbers = (str(request.config.num_envs), str(STEPS))
    command = [str(request.peer), str(_SCRIPT), request.device, *numbers]
    with TemporaryFile("w+") as messages:
        try:
            process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=messages, text=True
            )
        except OSError as error:
            raise ConfigError(f"--peer {request.peer}: {error.strerror}") from None

        questions, answers = process.stdin, process.stdout
        assert questions is not None and answers is not None

        def answer() -> Any:
            line = answers.readline()
            if not line:
                process.wait()
                messages.seek(0)
                last = (messages.read().strip().splitlines() or ["it said nothing"])[-1]
                raise ConfigError(f"--peer {request.peer}: mjlab did not run: {last}")
            return json.loads(line)

        def step() -> float:
            questions.write("\n")
            questions.flush()
            return answer() / STEPS

        with process:
            try:
                yield answer(), step
            finally:
                questions.close()


def table(figures: Figures) -> list[Table]:
    """Return both speeds."""
    title = f"control steps of {figures['worlds']} Go1 on {figures['device']}, zero actions"
    both = make_table(title, "ms", "env steps/s", "times mjlab's speed", "range")
    for name, seconds in figures["seconds_per_step"].items():
        rate = f"{figures['steps_per_second'][name]:,.0f}"
        faster = with_range(figures["times_as_fast"][name])
        both.add_row(name, f"{1e3 * seconds['median']:.2f}", rate, *faster)
    lines = (
        f"{name}: {figures['task'][name]}; "
        + ", ".join(f"{package} {version}" for package, version in versions.items())
        for name, versions in figures["versions"].items()
    )
    both.caption = "\n".join(lines)
    return [both]
