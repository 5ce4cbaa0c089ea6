"""Kill a training at random moments, go on each time, and compare its end with an undisturbed one.

PYTHONPATH=tests python -m campaigns.kills [KILLS [SEED]]

SIGKILL leaves no time to save. Half of the kills come at any moment, the others while a checkpoint
is being written. A training that ended before its turn is compared, and a new one is begun; at the
end every one has the bits of the undisturbed one.
"""

from __future__ import annotations

import random
import sys
import tempfile
import time
from collections.abc import Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path

from campaigns.trainings import differences, latest, start, train

_LOOK = 1e-4  # s


def campaign(kills: int, seed: int = 0) -> list[str]:
    """Kill trainings so many times; return the faults."""
    rng, faults = random.Random(seed), []
    with tempfile.TemporaryDirectory() as folder:
        whole, output = Path(folder, "whole"), Path(folder, "output.txt")
        begin = time.monotonic()
        if status := train(whole, output):
            return [f"the undisturbed training ends with {status}: {output.read_text()}"]
        seconds = time.monotonic() - begin
        number = 0
        while kills > 0:
            number += 1
            runs = Path(folder, f"training_{number}")
            kills -= _disturb(runs, output, _moments(rng, kills, seconds))
            faults += [f"training {number}: {x}" for x in _judge(runs, whole, output)]
    return faults


def _moments(rng: random.Random, count: int, seconds: float) -> Iterator[tuple[bool, float]]:
    """Yield whether to wait for a checkpoint that is being written, and how long after that, s."""
    for _ in range(count):
        writing = rng.random() < 0.5
        yield writing, rng.uniform(0.0, 0.005 if writing else seconds / 2)


def _disturb(runs: Path, output: Path, moments: Iterator[tuple[bool, float]]) -> int:
    """Kill a training again and again until it ends; return how often it was killed."""
    killed = 0
    for writing, delay in moments:
        process = start(runs, output)
        if writing:
            _await_writing(runs, process)
        process.join(delay)
        if not process.is_alive():
            break
        process.kill()
        process.join()
        killed += 1
    return killed


def _await_writing(runs: Path, process: BaseProcess) -> None:
    """Wait for a checkpoint that is not whole yet, or for the end."""
    known = set(runs.glob("smoke/*/checkpoints/.*"))
    while process.is_alive() and not set(runs.glob("smoke/*/checkpoints/.*")) - known:
        time.sleep(_LOOK)


def _judge(runs: Path, whole: Path, output: Path) -> list[str]:
    """Let a training end; return what is other than in the undisturbed one."""
    if status := train(runs, output):
        return [f"going on ends with {status}: {output.read_text()}"]
    mine, other = latest(runs), latest(whole)
    assert mine and other
    left = [f"{path.name} is left over" for path in mine.parents[1].rglob(".*.tmp")]
    return differences(mine, other) + left


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 50
    found = campaign(count, int(sys.argv[2]) if len(sys.argv) > 2 else 0)
    sys.stdout.write("\n".join([*found, f"{count} kills, {len(found)} faults\n"]))
    sys.exit(bool(found))
