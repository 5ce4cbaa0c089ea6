"""Run kiras-robot for long: what its loops keep of their periods, and what its memory grows by.

PYTHONPATH=tests python -m campaigns.soak real MINUTES [ROBOT ...]
PYTHONPATH=tests python -m campaigns.soak fast HOURS [ROBOT ...]

`real` starts the three processes on a simulated robot (kiras-robot --sim) and drives every skill
and every change from one to another, again and again. Printed are the periods of driver and
runtime, their misses, the memory of each process, and what the log found.

`fast` runs driver, runtime and robot in one process on a clock of its own, as fast as it can, with
a skill and a command by chance every few seconds, and everybody who is damped stood up again.
Printed are the computing time of a tick, the growth of memory, and what was found.

Robots are solo8 and go1, both where none is named. The status is 1 if a robot was damped, or a
transition is missing, or memory grew by more than GROWTH.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from rig import Rig, shipped

from kiras_rl.deploy.metadata import PolicyMetadata
from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.deploy.runtime.driver import Channel
from kiras_rl.deploy.runtime.mailbox import SHARED
from kiras_rl.deploy.runtime.messages import Request, State
from kiras_rl.deploy.runtime.pace import Times

ROBOTS = ("solo8", "go1")
GROWTH = 16.0  # MB, of a process after WARM: what its allocator may still take
WARM = 90.0  # s until memory is measured for the first time: by then the black box is full
DWELL = 4.0  # s in a skill, at least
STEPS = 4000  # of a script, at most: it is one argument of a command
SPEED = 0.2  # m/s
NEVER_UP = "a fall from which it did not get up"

_PACE = re.compile(
    r"(driver|runtime): (\d+) ticks late by (.*?) ms; periods (.*?) ms; (\d+) misses"
)


def tour(count: int) -> list[int]:
    """Return a walk through so many skills in which every change from one to another happens."""
    places = [0]
    for one in range(count - 1):
        for other in range(one + 1, count):
            places += [other, one]
        places.append(one + 1)
    return places


def changes(places: Sequence[object]) -> set[tuple[object, object]]:
    """Return the changes of a walk."""
    return {(a, b) for a, b in pairwise(places) if a != b}


def script_of(metadata: PolicyMetadata, seconds: float) -> str:
    """Return a script of kiras-robot that takes about so long, and whole tours."""
    places = tour(len(metadata.skills))
    dwell = max(DWELL, seconds / STEPS)
    rounds = max(1, round(seconds / (dwell * len(places))))
    words = [f"{metadata.skills[place]}:{dwell:g}:{SPEED}" for place in places]
    return ",".join(["on", "stand", *rounds * words, "lie", "quit"])


@dataclass
class Report:
    """What came of a run; lines for people, and what broke a rule."""

    lines: list[str] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)


# --- at real time --------------------------------------------------------------------------------


def real(robot: str, minutes: float, path: Path | None = None) -> Report:
    """Drive a simulated robot by its processes, at real time.

    Args:
        robot: Its name.
        minutes: About how long; at least one tour.
        path: The policy file; None for the one that is shipped.
    """
    path = path or shipped(robot)
    metadata = OnboardPolicy(path).metadata
    root = SHARED if SHARED.is_dir() else None
    with tempfile.TemporaryDirectory(dir=root) as shared, tempfile.TemporaryDirectory() as out:
        words = [sys.executable, "-m", "kiras_rl.deploy.runtime.command", "--sim", str(path)]
        words += ["--script", script_of(metadata, 60 * minutes), "--out", out]
        environment = {**os.environ, "KIRAS_ROBOT_SHARED": shared}
        session = subprocess.Popen(words, env=environment, stdout=subprocess.DEVNULL)
        memory = _watch(session, Channel(robot, Path(shared)))
        logs = [path.read_text(encoding="utf-8") for path in Path(out).glob("*/events.log")]
    return _judge(metadata, "".join(logs), memory)


def _watch(session: subprocess.Popen, channel: Channel) -> dict[str, list[float]]:
    """Measure the memory of the processes until the session ends, MB."""
    seats = {name: getattr(channel, name).path for name in ("driver", "runtime", "operator")}
    memory: dict[str, list[float]] = {name: [] for name in seats}
    begun = time.monotonic()
    while session.poll() is None:
        time.sleep(1.0)
        if time.monotonic() - begun < WARM:
            continue
        for name, seat in seats.items():
            size = _resident(seat.read_text() if seat.is_file() else "")
            if size:
                memory[name].append(size)
    return memory


def _resident(process: str) -> float:
    """Return the resident memory of a process, MB, or 0 if it has ended."""
    try:
        pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    except (OSError, IndexError, ValueError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def _judge(metadata: PolicyMetadata, events: str, memory: dict[str, list[float]]) -> Report:
    report, robot = Report(), metadata.robot
    for process, ticks, late, periods, misses in _PACE.findall(events):
        report.lines.append(f"| {robot} | {process} | {ticks} | {periods} | {late} | {misses} |")
    for name, sizes in memory.items():
        if sizes:
            report.lines.append(f"{robot}, {name}: {sizes[0]:.1f} MB, at the end {sizes[-1]:.1f}")
            if sizes[-1] - sizes[0] > GROWTH:
                report.broken.append(f"{robot}: the {name} grew by {sizes[-1] - sizes[0]:.1f} MB")
    skills = [metadata.skills[0], *re.findall(r"runtime: skill (\S+)", events)]
    count = len(metadata.skills)
    done = len(changes(skills))
    report.lines.append(f"{robot}: {done} of {count * (count - 1)} changes of skill, "
                        f"{len(skills) - 1} in all")  # fmt: skip
    if done < count * (count - 1):
        report.broken.append(f"{robot}: not every change of skill happened")
    if len(_PACE.findall(events)) < 2:
        report.broken.append(f"{robot}: the processes did not say how punctual they were")
    found = Counter(re.findall(r"runtime: (damped by \w+|lies down: .*)", events))
    found.pop("lies down: the operator leaves", None)
    report.broken += [f"{robot}: {text}, {number} times" for text, number in found.items()]
    return report


# --- faster --------------------------------------------------------------------------------------


def fast(robot: str, hours: float, seed: int = 0) -> Report:
    """Drive a simulated robot on a clock of its own.

    Args:
        robot: Its name.
        hours: Simulated.
        seed: Of skills and commands.
    """
    with tempfile.TemporaryDirectory() as folder:
        rig, random = Rig(robot, Path(folder), seed), np.random.default_rng(seed)
        ticks, faults = _time_ticks(rig), Counter()
        rig.walk()
        begun, start, first = time.monotonic(), rig.now, 0.0
        while (rig.now - start) / 1e9 < 3600 * hours and not faults[NEVER_UP]:
            _drive_by_chance(rig, random, faults)
            first = first or (_resident("self") if rig.now - start > WARM * 1e9 else 0.0)
        last, simulated = _resident("self"), (rig.now - start) / 1e9
    speed = simulated / (time.monotonic() - begun)
    report = Report([f"{robot}: {simulated / 3600:.2f} h simulated, {speed:.2f} times real time"])
    report.lines += [f"{robot}, {name}: a tick takes {times.line()}" for name, times in ticks]
    report.lines.append(f"{robot}, memory: {first:.1f} MB, at the end {last:.1f}")
    if first and last - first > GROWTH:
        report.broken.append(f"{robot}: memory grew by {last - first:.1f} MB")
    report.broken += [f"{robot}: {why}, {number} times" for why, number in faults.items()]
    return report


def _time_ticks(rig: Rig) -> list[tuple[str, Times]]:
    """Measure the computing time of both loops from now on."""

    def measured(owner: object) -> Times:
        times, tick = Times(), owner.tick

        def timed(*arguments: object) -> object:
            begun = time.perf_counter_ns()
            try:
                return tick(*arguments)
            finally:
                times.add(time.perf_counter_ns() - begun)

        owner.tick = timed
        return times

    return [("driver with its robot", measured(rig.driver)), ("runtime", measured(rig.runtime))]


def _drive_by_chance(rig: Rig, random: np.random.Generator, faults: Counter) -> None:
    """Drive for some seconds; stand a robot up that was damped."""
    if rig.runtime.state == State.DAMPED:
        (why,) = (line for line in rig.log if line.startswith("damped by"))
        faults[f"{why} (in {rig.policy.metadata.skills[rig.runtime.skill]})"] += 1
        rig.run(1.0)
        rig.press(Request.ACKNOWLEDGE)
        try:
            rig.walk()
        except AssertionError:
            faults[NEVER_UP] += 1
            return
    rig.modes.clear()
    rig.log.clear()
    low, high = np.array(list(vars(rig.policy.metadata.command_range).values())).T
    skill = str(random.choice(rig.policy.metadata.skills))
    rig.drive(skill, tuple(0.5 * random.uniform(low, high)))
    rig.run(float(random.uniform(3.0, 8.0)))


# --- the command ---------------------------------------------------------------------------------

HEAD = ("robot", "process", "ticks", "period, ms", "late, ms", "misses")


def reports(kind: str, length: float, robots: Sequence[str]) -> Iterator[Report]:
    """Run one robot after the other."""
    for robot in robots:
        yield real(robot, length) if kind == "real" else fast(robot, length)


def main(words: Sequence[str]) -> int:
    """Run the campaign; return its exit status."""
    kinds, broken = ("real", "fast"), []
    if len(words) < 2 or words[0] not in kinds or not set(words[2:]) <= set(ROBOTS):
        sys.stderr.write("error: give real MINUTES or fast HOURS, and robots of solo8, go1\n")
        return 2
    if words[0] == "real":
        sys.stdout.write(f"| {' | '.join(HEAD)} |\n|{' --- |' * len(HEAD)}\n")
    for report in reports(words[0], float(words[1]), words[2:] or ROBOTS):
        sys.stdout.write("\n".join(report.lines) + "\n")
        sys.stdout.flush()
        broken += report.broken
    sys.stdout.write("".join(f"BROKEN {what}\n" for what in broken))
    return bool(broken)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
