"""The driver's and the runtime's processes, which kiras-robot starts."""

from __future__ import annotations

import gc
import json
import os
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from kiras_rl.deploy.errors import PlainError
from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.deploy.profile import Profile
from kiras_rl.deploy.runtime.blackbox import LENGTH, Ring
from kiras_rl.deploy.runtime.driver import Channel, Driver, Link, LinkError, keep_pace
from kiras_rl.deploy.runtime.go1 import Go1
from kiras_rl.deploy.runtime.machine import Runtime
from kiras_rl.deploy.runtime.mailbox import SHARED
from kiras_rl.deploy.runtime.messages import NANO, State
from kiras_rl.deploy.runtime.profiles import profile_of
from kiras_rl.deploy.runtime.solo8 import Solo8, open_socket, read_calibration

PRIORITIES = {"driver": 80, "runtime": 70}  # of SCHED_FIFO, where the system lets us have it
ALONE = 30.0  # s that a runtime whose operator is gone waits, lying, before it ends
ROLES = ("driver", "runtime")


@dataclass(frozen=True)
class Setup:
    """What the processes are told; plain values, for they travel as JSON."""

    policy: str
    """The policy file."""
    link: str
    """sim, go1 or solo8."""
    log: str
    """The file that events are appended to."""
    address: str = ""
    """Of the robot: host:port on Go1, empty for its usual one; a network interface on Solo-8."""
    calibration: str = ""
    """Solo-8: the file with the angles of the joints at their encoders' index."""
    deadman: bool = False
    """Whether a button has to be held for a command to count."""
    seed: int = 0
    """Simulated robot: of how it lies, and of the noise."""
    root: str = str(SHARED)
    """Folder in memory, for the channel."""

    def to_json(self) -> str:
        """Return the text that `main` reads."""
        return json.dumps(asdict(self))


class Log:
    """A file of lines, each with the seconds of the monotonic clock."""

    def __init__(self, path: str, who: str) -> None:
        """Append to a file."""
        self._file = open(path, "a", encoding="utf-8", buffering=1)  # noqa: SIM115, for the process's life
        self._who = who

    def __call__(self, text: str) -> None:
        """Write a line; a disk that is full costs the line, and nothing else."""
        with suppress(OSError):
            self._file.write(f"{time.monotonic():.3f} {self._who}: {text}\n")


def open_link(setup: Setup, policy: OnboardPolicy, profile: Profile) -> Link:
    """Reach the robot, real or simulated.

    Raises:
        LinkError: If it cannot be reached.
    """
    if setup.link == "sim":
        try:
            from kiras_rl.deploy.runtime.simulated import Plant, SimulatedRobot
        except ImportError as error:
            raise LinkError(
                f"--sim needs the whole project, kiras-rl with MuJoCo ({error}); "
                "the onboard package alone drives real robots"
            ) from None
        return SimulatedRobot(Plant(policy.metadata, profile, setup.seed), profile.rate)
    joints, torque = policy.metadata.num_joints, np.array(policy.metadata.torque_limit)
    if setup.link == "go1":
        return Go1(setup.address, joints, profile.damping)
    offsets = read_calibration(setup.calibration)
    return Solo8(open_socket(setup.address), offsets, torque, profile.damping)


def _join(setup: Setup) -> tuple[OnboardPolicy, Profile, Channel]:
    """Load the policy, and open the channel of its robot."""
    policy = OnboardPolicy(setup.policy)
    channel = Channel(policy.metadata.base_robot, Path(setup.root))
    return policy, profile_of(policy.metadata), channel


def drive(setup: Setup) -> None:
    """Be the driver."""
    log = Log(setup.log, "driver")
    policy, profile, channel = _join(setup)
    channel.driver.take()
    link = open_link(setup, policy, profile)
    ring = Ring(channel.ring, round(LENGTH * profile.rate))
    driver = Driver(link, channel, ring, log)
    _calm("driver", log)
    ended = _until_told()
    log(f"runs at {profile.rate:g} Hz")
    try:
        log(driver.run(profile.rate, ended).line())
    finally:
        link.close()


def run(setup: Setup) -> None:
    """Be the runtime."""
    log = Log(setup.log, "runtime")
    policy, profile, channel = _join(setup)
    channel.runtime.take()
    runtime = Runtime(policy, profile, log, setup.deadman)
    _calm("runtime", log)
    ended = _until_told()
    alone = time.monotonic_ns()

    def tick(now: int) -> bool:
        nonlocal alone
        channel.orders.put(runtime.tick(channel.readings.get(), channel.wishes.get(), now))
        if channel.operator.is_taken() or runtime.state not in _RESTING:
            alone = now
        return ended() or runtime.finished or now - alone > ALONE * NANO

    log(f"runs at {policy.metadata.control_rate:g} Hz")
    log(keep_pace(tick, policy.metadata.control_rate).line())


_RESTING = (State.OFF, State.CONNECTED, State.CALIBRATED, State.LYING, State.DAMPED)


def _until_told() -> Callable[[], bool]:
    """Return a function that tells whether SIGTERM has come; Ctrl-C is the operator's alone."""
    told = []
    signal.signal(signal.SIGTERM, lambda number, frame: told.append(number))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    return lambda: bool(told)


def _calm(role: str, log: Log) -> None:
    """Ask for what keeps a loop punctual."""
    gc.collect()
    gc.freeze()  # what is there now is never looked at again
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITIES[role]))
    except OSError:
        log("runs without real-time priority: sudo setcap cap_sys_nice+ep, or run as root")


def main(arguments: list[str] | None = None) -> int:
    """Be the process that is asked for; return its exit status."""
    role, text = sys.argv[1:] if arguments is None else arguments
    setup = Setup(**json.loads(text))
    try:
        drive(setup) if role == "driver" else run(setup)
    except (PlainError, OSError) as error:
        Log(setup.log, role)(f"error: {error}")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
