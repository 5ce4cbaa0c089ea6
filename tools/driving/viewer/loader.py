"""Policies that are loaded while another one drives."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from kiras_rl.deploy.policy import OnboardPolicy, PolicyError
from kiras_rl.tools.driving.viewer.choices import newest_checkpoint
from kiras_rl.tools.shared.policy_files import find_policy

_POLL_SECONDS = 2.0


@dataclass(frozen=True)
class Loaded:
    """A policy that is ready, or the reason why it is not."""

    title: str
    policy: OnboardPolicy | None
    error: str = ""


class Loader:
    """Loads one policy at a time, in the background; of waiting requests the last one counts."""

    def __init__(self) -> None:
        """Start without anything to do."""
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="policies")
        self._running: tuple[str, Future[OnboardPolicy]] | None = None
        self._waiting: tuple[Path, str] | None = None

    def request(self, source: Path, title: str) -> None:
        """Ask for the policy of a file or a run folder."""
        self._waiting = (source, title)

    def poll(self) -> Loaded | None:
        """Return what has become ready since the last call; start what is waiting."""
        ready = None
        if self._running and self._running[1].done():
            title, future = self._running
            self._running = None
            error = future.exception()
            if error is not None and not isinstance(error, (PolicyError, OSError)):
                raise error
            ready = Loaded(title, None if error else future.result(), str(error or ""))
        if self._running is None and self._waiting:
            source, title = self._waiting
            self._waiting = None
            self._running = title, self._pool.submit(load, source)
        return ready

    def close(self) -> None:
        """Forget what is waiting; what is running comes to its end unheard."""
        self._pool.shutdown(wait=False, cancel_futures=True)


def load(source: Path) -> OnboardPolicy:
    """Load a policy file, a checkpoint or a run; without torch in this process.

    Raises:
        PolicyError: If there is none, or it cannot be exported.
    """
    path = find_policy(source)
    if path.suffix == ".onnx":
        return OnboardPolicy(path)
    with TemporaryDirectory() as folder:
        exported = Path(folder) / "policy.onnx"
        # in a process of its own: torch would hold the interpreter for seconds, and the robot
        # -P: what lies in the current folder is not what is installed
        command = [sys.executable, "-P", "-m", "kiras_rl.tools.export", path, "--out", exported]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            reason = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
            raise PolicyError(reason.removeprefix("error: "))
        return OnboardPolicy(exported)


class Follower:
    """Watches a run for checkpoints."""

    def __init__(self, run: Path, now: Callable[[], float]) -> None:
        """Take what is there as known.

        Args:
            run: The run's folder.
            now: Returns the time, s.

        Raises:
            PolicyError: If the path is not the folder of one run.
        """
        self._run, self._now = run, now
        self._known = self._stamp()
        self._next = now() + _POLL_SECONDS

    def poll(self) -> Path | None:
        """Return the newest checkpoint, once after it has been written."""
        if self._now() < self._next:
            return None
        self._next = self._now() + _POLL_SECONDS
        stamp = self._stamp()
        if stamp is None or stamp == self._known:
            return None
        self._known = stamp
        return stamp[0]

    def _stamp(self) -> tuple[Path, int] | None:
        path = newest_checkpoint(self._run)
        return None if path is None else (path, path.stat().st_mtime_ns)
