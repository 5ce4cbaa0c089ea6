"""Runs of a sweep at the same time, each in a process of its own on its share of the cores.

One training does not fill several cores: parts of it run on one thread, and the threads of the
others wait for each other after every operation. Runs that share the cores waste less of them.
"""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import Future, ThreadPoolExecutor, wait
from itertools import pairwise
from queue import SimpleQueue
from threading import Lock

from kiras_rl.checkpoint import CheckpointError
from kiras_rl.config import ConfigError
from kiras_rl.process import StopRequest
from kiras_rl.tools.training.run import console
from kiras_rl.tools.training.sweep import Report, Run, try_out

POLL = 0.2  # s between looks at whether to stop


def train_side_by_side(runs: list[Run], jobs: int, command: list[str]) -> Report:
    """Train the runs that are not finished, several at a time, as `train_sweep` does.

    SIGINT and SIGTERM reach every process: each ends its iteration, saves, and returns.

    Args:
        runs: The sweep.
        jobs: How many train at a time; the cores of this process are divided among them.
        command: Arguments of kiras-train for this sweep; each process gets the name of its run.

    Raises:
        ConfigError: More jobs than cores, or what a run could not use, before the first one trains.
    """
    processes = _Processes(core_shares(jobs), command)
    try_out(runs)
    with StopRequest() as stop, ThreadPoolExecutor(jobs) as pool:
        results = {run.name: pool.submit(processes.train, run) for run in runs}
        try:
            _wait_for(list(results.values()), stop, processes)
        except BaseException:  # a second Ctrl-C
            processes.stop(at_once=True)
            raise
    failures = {name for name, result in results.items() if not result.result()}
    is_left = any(run.name not in failures and not _is_finished(run) for run in runs)
    return Report(runs, failures, stop.requested and is_left)


def core_shares(jobs: int) -> list[set[int]]:
    """Divide the cores that this process may use; raises ConfigError if there are too few."""
    cores = sorted(os.sched_getaffinity(0))
    if jobs > len(cores):
        raise ConfigError(f"--jobs {jobs}: this process has {len(cores)} cores; give at most that")
    ends = [len(cores) * job // jobs for job in range(jobs + 1)]
    return [set(cores[begin:end]) for begin, end in pairwise(ends)]


def _is_finished(run: Run) -> bool:
    try:
        return run.is_finished()
    except CheckpointError:
        return False


def _wait_for(results: list[Future], stop: StopRequest, processes: _Processes) -> None:
    while wait(results, timeout=POLL).not_done:
        if stop.requested:
            processes.stop()


class _Processes:
    """The processes that train now; a thread of the pool waits for each."""

    def __init__(self, shares: list[set[int]], command: list[str]) -> None:
        self._command = [sys.executable, "-P", "-m", "kiras_rl.tools.train", *command]
        self._free: SimpleQueue[set[int]] = SimpleQueue()
        for share in shares:
            self._free.put(share)
        self._running: set[subprocess.Popen] = set()
        self._stopped = False
        self._lock = Lock()

    def train(self, run: Run) -> bool:
        """Train a run to its end, or until it is stopped; return whether it did not break."""
        share = self._free.get()
        try:
            process = self._start(run, share)
            if process is None:
                return True
            with process:
                assert process.stdout is not None
                for line in process.stdout:
                    _say(run, line.rstrip())
            with self._lock:
                self._running.remove(process)
                return self._stopped or process.returncode == 0
        finally:
            self._free.put(share)

    def _start(self, run: Run, share: set[int]) -> subprocess.Popen | None:
        os.sched_setaffinity(0, share)  # of this thread, whose children inherit it
        with self._lock:
            if self._stopped:
                return None
            process = subprocess.Popen(
                [*self._command, "--only", run.name],
                stdout=subprocess.PIPE,
                text=True,
                env=os.environ | {"OMP_NUM_THREADS": str(len(share))},
                process_group=0,  # Ctrl-C in a terminal would reach it there, and then once more
            )
            self._running.add(process)
            return process

    def stop(self, at_once: bool = False) -> None:
        """Let all save and end, and start no other; asked again, do nothing."""
        with self._lock:
            for process in self._running if at_once or not self._stopped else ():
                process.kill() if at_once else process.terminate()
            self._stopped = True


def _say(run: Run, line: str) -> None:
    console.print(f"{run.name} | {line}", highlight=False, markup=False, soft_wrap=True)
