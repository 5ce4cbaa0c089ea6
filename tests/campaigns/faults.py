"""Break one thing of a robot that walks, and see what driver, runtime and log make of it.

PYTHONPATH=tests python -m campaigns.faults [TRIALS OF EACH] [TRIALS WITH PROCESSES]

Both robots walk in a simulation, through the messages of their electronics, on a clock of their
own. Each trial is a fork of a robot in full stride; processes that are killed or stopped are real,
and at real time. Printed are a table, and every trial that broke a rule: damped or held in time,
the fault named in the log, torque within the motors' limit, the base not faster than SPEED.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from electronics import MS, WORLDS, calibrate_hung_up, drain
from patience import patience
from rig import Rig, shipped

from kiras_rl.deploy.runtime.driver import Channel, Link
from kiras_rl.deploy.runtime.messages import Mode, State

SPEED = 3.0  # m/s, of the base: what a fall from standing reaches is less
AFTER = 1.2  # s that a trial goes on after its fault
TICK = 20.0  # ms, a control period


class Spoiled(Link):
    """A link whose measurements can be changed on their way to the driver."""

    def __init__(self, link: Link) -> None:
        self.inner, self.change = link, lambda reading: None

    def receive(self, reading: np.ndarray, now: int) -> bool:
        came = self.inner.receive(reading, now)
        self.change(reading)
        return came

    def send(self, mode: Mode, order: np.ndarray, now: int) -> None:
        self.inner.send(mode, order, now)


@dataclass(frozen=True)
class Fault:
    """One way to break a robot.

    Attributes:
        break_it: Does it, with a generator for what is left to chance.
        names: Checks that may name it; none for what the robot has to bear, or may.
        within: ms until the motors are held or damped; infinite where they need not be.
        bears: Whether the robot has to go on as if nothing were.
        ends_in: States of which it has to be in one at the end; none for any.
    """

    break_it: Callable[[Rig, np.random.Generator], None]
    names: tuple[str, ...] = ()
    within: float = np.inf
    bears: bool = False
    ends_in: tuple[str, ...] = ()


def _drop(share: float) -> Callable[[Rig, np.random.Generator], None]:
    def break_it(rig: Rig, random: np.random.Generator) -> None:
        rig.electronics.spoil = lambda data, now: [data] if random.random() >= share else []

    return break_it


def _delay(ms: int) -> Callable[[Rig, np.random.Generator], None]:
    def break_it(rig: Rig, random: np.random.Generator) -> None:
        queue: list[tuple[int, bytes]] = []

        def spoil(data: bytes, now: int) -> list[bytes]:
            queue.append((now + ms * MS, data))
            due = [message for moment, message in queue if moment <= now]
            del queue[: len(due)]
            return due

        rig.electronics.spoil = spoil

    return break_it


def _double(rig: Rig, random: np.random.Generator) -> None:
    rig.electronics.spoil = lambda data, now: [data, data]


def _reorder(rig: Rig, random: np.random.Generator) -> None:
    kept: list[bytes] = []

    def spoil(data: bytes, now: int) -> list[bytes]:
        kept.append(data)
        if len(kept) < 3:
            return []
        return [kept.pop(int(random.integers(3))), *([] if random.random() < 0.5 else [kept[0]])]

    rig.electronics.spoil = spoil


def _order_late(ms: int) -> Callable[[Rig, np.random.Generator], None]:
    def break_it(rig: Rig, random: np.random.Generator) -> None:
        rig.order_delay = ms * MS

    return break_it


def _changed(change: Callable) -> Callable[[Rig, np.random.Generator], None]:
    """Return what changes every reading from now on: change(reading, joint, joints, kept)."""

    def break_it(rig: Rig, random: np.random.Generator) -> None:
        joints = rig.policy.metadata.num_joints
        joint, kept = int(random.integers(joints)), {}
        rig.link.change = lambda reading: change(reading, joint, joints, kept)

    return break_it


def _nan(reading: np.ndarray, joint: int, joints: int, kept: dict) -> None:
    reading["joint_vel"][joint] = np.nan


def _freeze(reading: np.ndarray, joint: int, joints: int, kept: dict) -> None:
    for name in ("joint_pos", "joint_vel"):
        reading[name][joint] = kept.setdefault(name, float(reading[name][joint]))


def _wrong_zero(reading: np.ndarray, joint: int, joints: int, kept: dict) -> None:
    reading["joint_pos"][joint] += 0.5


def _swap(reading: np.ndarray, joint: int, joints: int, kept: dict) -> None:
    pair = [joint, (joint + 1) % joints]
    for name in ("joint_pos", "joint_vel"):
        reading[name][pair] = reading[name][pair[::-1]]


def _upside_down(reading: np.ndarray, joint: int, joints: int, kept: dict) -> None:
    w, x, y, z = reading["quat"]
    reading["quat"] = -x, w, z, -y  # turned by pi about its own x
    reading["gyro"][1:] *= -1
    reading["acc"][1:] *= -1


def _overtorque(reading: np.ndarray, joint: int, joints: int, kept: dict) -> None:
    reading["torque"][joint] = 99.0


def _topple(rig: Rig, random: np.random.Generator) -> None:
    rig.plant.data.qvel[3] += 14.0 * random.choice((-1, 1))  # rad/s, about its length
    rig.plant.data.qvel[2] += 1.5


def _pull_cable(rig: Rig, random: np.random.Generator) -> None:
    rig.electronics.plugged = False


def _lose_gamepad(rig: Rig, random: np.random.Generator) -> None:
    rig.wish["connected"] = 0


def _press(rig: Rig, random: np.random.Generator) -> None:
    rig.wish["emergency"] = 1


def _jump(seconds: float) -> Callable[[Rig, np.random.Generator], None]:
    def break_it(rig: Rig, random: np.random.Generator) -> None:
        rig.jump = round(seconds * 1e9)

    return break_it


STALE, CLOCK = ("stale",), ("stale", "driver", "deadline")
FAULTS = {
    "nothing": Fault(lambda rig, random: None, bears=True),
    "messages dropped, 30 %": Fault(_drop(0.3), bears=True),
    "messages dropped, all": Fault(_drop(1.0), STALE, 80),
    "messages 5 ms late": Fault(_delay(5), bears=True),
    "messages 20 ms late": Fault(_delay(20)),
    # The gap of 50 ms at its start may lie between two ticks that see 30 and 10 ms of age.
    "messages 50 ms late": Fault(_delay(50), ("stale", "")),
    **{f"messages {ms} ms late": Fault(_delay(ms), STALE, 80) for ms in (100, 200)},
    "messages doubled": Fault(_double, bears=True),
    "messages reordered": Fault(_reorder, bears=True),
    "orders 5 ms late": Fault(_order_late(5), bears=True),
    "orders 20 ms late": Fault(_order_late(20)),
    **{f"orders {ms} ms late": Fault(_order_late(ms), (), 80) for ms in (50, 100)},
    "orders 200 ms late": Fault(_order_late(200), ("driver",), 80),
    "a NaN": Fault(_changed(_nan), ("finite",), 40),
    # Found once its target has travelled: a joint that hardly moves takes longer than a trial.
    "an encoder frozen": Fault(_changed(_freeze), ("frozen", "")),
    "a zero wrong by 0.5 rad": Fault(_changed(_wrong_zero)),
    "two joints swapped": Fault(_changed(_swap)),
    "the IMU upside down": Fault(_changed(_upside_down), ("tilt",), 40),
    "thrown onto its side": Fault(_topple, ("tilt", "falling", "range", "speed"), 1000),
    "a motor beyond its torque": Fault(_changed(_overtorque), ("torque", "power"), 80),
    "the cable pulled": Fault(_pull_cable, STALE, 80),
    "the emergency button": Fault(_press, ("emergency",), 20),
    "the gamepad gone": Fault(_lose_gamepad, ends_in=("LOWERING", "LYING")),
    "the clock 1 s ahead": Fault(_jump(1.0), CLOCK, 40),
    "the clock 1 s back": Fault(_jump(-1.0), CLOCK, 40),
}


@dataclass
class Result:
    """What a trial ended in; delay in ms until the motors were held or damped, or None."""

    delay: float | None
    state: str
    name: str
    speed: float
    torque: float

    def breaks(self, fault: Fault, limit: float) -> str:
        if self.torque > limit * 1.001:
            return f"torque {self.torque:.1f} N m"
        if self.speed > SPEED:
            return f"base at {self.speed:.1f} m/s"
        if fault.within < np.inf and (self.delay is None or self.delay > fault.within):
            return f"held or damped after {self.delay} ms"
        if fault.bears and self.delay is not None:
            return f"held or damped after {self.delay} ms"
        if fault.ends_in and self.state not in fault.ends_in:
            return f"ended in {self.state}"
        if fault.names and self.name not in fault.names:
            return f"named {self.name or 'nothing'}"
        return "" if self.state != "DAMPED" or self.name else "damped without a name"


def walking(robot: str, folder: Path, seed: int) -> Rig:
    """Return a robot in full stride, behind its electronics."""
    rig = Rig(robot, folder, seed, Spoiled, WORLDS[robot])
    if robot == "solo8":
        calibrate_hung_up(rig)
    rig.walk("walk", (0.3, 0.0, 0.0))
    rig.run(1.5)
    return rig


def _try(rig: Rig, fault: Fault, seed: int) -> Result:
    """Break a walking robot; in a process of its own, for the rig is then used up."""
    random = np.random.default_rng(seed)
    for box in (rig.channel.readings, rig.channel.orders, rig.channel.wishes):
        box.clear()
    rig.electronics.drain()
    drain(getattr(rig.link.inner, "_socket", None) or rig.link.inner._wire)
    skill = random.choice(rig.policy.metadata.skills)
    rig.drive(str(skill), (float(random.uniform(-0.2, 0.4)), 0.0, float(random.uniform(-0.4, 0.4))))
    rig.run(float(random.uniform(0.2, 1.0)))
    if rig.runtime.state != State.POLICY:
        raise RuntimeError(f"did not walk: {rig.log[-3:]}")
    rig.modes, rig.speed, rig.torque = [], 0.0, 0.0
    fault.break_it(rig, random)
    rig.run(2.5 if fault.break_it is _lose_gamepad else AFTER)
    stopped = [i for i, mode in enumerate(rig.modes) if mode in (Mode.HOLD, Mode.DAMP)]
    delay = 1000 * stopped[0] / rig.profile.rate if stopped else None
    state = rig.runtime.state.name
    return Result(delay, state, rig.runtime.fault, rig.speed, rig.torque)


def _forked(rig: Rig, fault: Fault, seed: int) -> Result | str:
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        try:
            answer = json.dumps(vars(_try(rig, fault, seed)))
        except BaseException as error:
            answer = json.dumps(f"{type(error).__name__}: {error}")
        os.write(writer, answer.encode())
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as pipe:
        answer = json.loads(pipe.read() or '"the trial crashed"')
    os.waitpid(child, 0)
    return answer if isinstance(answer, str) else Result(**answer)


def campaign(trials: int, robots: tuple[str, ...] = ("solo8", "go1")) -> tuple[list, list[str]]:
    """Break robots in every way.

    Args:
        trials: Of each fault and robot.
        robots: Their names.

    Returns:
        Rows of the table (robot, fault, results), and what broke a rule.
    """
    rows, broken = [], []
    for robot in robots:
        with tempfile.TemporaryDirectory() as folder:
            rig = walking(robot, Path(folder), seed=0)
            limit = max(rig.policy.metadata.torque_limit)
            for name, fault in FAULTS.items():
                results = [_forked(rig, fault, seed) for seed in range(trials)]
                wrong = [r if isinstance(r, str) else r.breaks(fault, limit) for r in results]
                broken += [f"{robot}, {name}, {i}: {why}" for i, why in enumerate(wrong) if why]
                rows.append((robot, name, [r for r in results if isinstance(r, Result)]))
            rig.link.inner.close()
            rig.electronics.close()
    return rows, broken


# --- processes -----------------------------------------------------------------------------------

ENDS = {"SIGKILL": signal.SIGKILL, "SIGSTOP": signal.SIGSTOP}


def try_process(role: str, end: str, folder: Path) -> str:
    """End or stop one process of a simulated robot that walks, and return what the log says of it.

    Raises:
        RuntimeError: If it never walked, or its motors were not damped, or did not lie down.
    """
    root, out = folder / "shared", folder / "out"
    words = [sys.executable, "-m", "kiras_rl.deploy.runtime.command", "--sim", str(shipped("go1"))]
    words += ["--script", "on,stand,walk:600:0.2", "--out", str(out)]
    environment = {**os.environ, "KIRAS_ROBOT_SHARED": str(root)}
    session = subprocess.Popen(
        words, env=environment, start_new_session=True, stdout=subprocess.DEVNULL
    )
    channel = Channel("go1", root)
    others: list[int] = []
    try:
        _wait(lambda: _state(channel) == State.POLICY, "it never walked")
        time.sleep(1.0)
        seats = {name: getattr(channel, name).path for name in ("operator", "runtime", "driver")}
        others = [int(path.read_text()) for path in seats.values()]
        os.kill(int(seats[role].read_text()), ENDS[end])
        # Its plant ends with the driver; motor boards switch off by themselves. The runtime is over
        # soon after, so its log is asked, not its state.
        if role == "driver":
            _wait(lambda: "damped by" in _events(out), "the runtime did not see it")
        elif role == "runtime":
            _wait(lambda: channel.readings.get()["mode"] == Mode.DAMP, "it was not damped")
        else:
            _wait(lambda: _state(channel) == State.LYING, "it did not lie down")
        return _events(out)
    finally:
        for process in (session.pid, *others):
            for number in (signal.SIGCONT, signal.SIGKILL):
                try:
                    os.kill(process, number)
                except ProcessLookupError:
                    break
        session.wait()


def _events(out: Path) -> str:
    (log,) = out.glob("*/events.log")
    return log.read_text(encoding="utf-8")


def _state(channel: Channel) -> State:
    order = channel.orders.get()
    return State.OFF if order is None else State(int(order["state"]))


def _wait(is_so: Callable[[], bool], complaint: str) -> None:
    end = time.monotonic() + patience()
    while not is_so():
        if time.monotonic() > end:
            raise RuntimeError(complaint)
        time.sleep(0.01)


SAYS = {
    ("driver", "SIGKILL"): "damped by stale",
    ("driver", "SIGSTOP"): "damped by stale",
    ("runtime", "SIGKILL"): "damps by itself: runtime is gone",
    ("runtime", "SIGSTOP"): "damps by itself: no order for",
    ("operator", "SIGKILL"): "lies down: the operator is lost",
    ("operator", "SIGSTOP"): "lies down: the operator is lost",
}
"""What the log has to say, by process and signal."""


def processes(trials: int) -> list[str]:
    """End and stop every process, and return what broke a rule."""
    broken = []
    for (role, end), expected in SAYS.items():
        for number in range(trials):
            with tempfile.TemporaryDirectory() as folder:
                try:
                    log = try_process(role, end, Path(folder))
                except RuntimeError as error:
                    broken.append(f"{end} of the {role}, {number}: {error}")
                    continue
            if expected not in log:
                broken.append(f"{end} of the {role}, {number}: the log lacks '{expected}'")
    return broken


def line(robot: str, name: str, results: list[Result]) -> str:
    """Return a row of the table."""
    delays = [r.delay for r in results if r.delay is not None]
    span = f"{min(delays):.0f} to {max(delays):.0f} ({len(delays)})" if delays else "never"
    named = ", ".join(f"`{name}`" for name in sorted({r.name for r in results} - {""})) or "-"
    speed, torque = max(r.speed for r in results), max(r.torque for r in results)
    return f"| {robot} | {name} | {len(results)} | {span} | {named} | {speed:.1f} | {torque:.1f} |"


def main() -> int:
    """Run the campaign; return its exit status."""
    trials, with_processes = (int(word) for word in [*sys.argv[1:], "5", "1"][:2])
    head = ("robot", "fault", "trials", "held or damped after, ms", "named", "m/s", "N m")
    rows, broken = campaign(trials)
    broken += processes(with_processes)
    count = sum(len(results) for _, _, results in rows) + with_processes * len(SAYS)
    text = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}", *(line(*row) for row in rows)]
    text += [*(f"BROKEN {what}" for what in broken), f"{count} trials, {len(broken)} broke a rule"]
    sys.stdout.write("\n".join(text) + "\n")
    return bool(broken)


if __name__ == "__main__":
    sys.exit(main())
