"""kiras-robot: run a policy on a robot, or on a simulated one, and look at it before."""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from kiras_rl.deploy.errors import PlainError
from kiras_rl.deploy.metadata import PolicyError, PolicyMetadata
from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.deploy.runtime import preflight
from kiras_rl.deploy.runtime.blackbox import Ring, save
from kiras_rl.deploy.runtime.driver import Channel, keep_pace
from kiras_rl.deploy.runtime.hands import EMERGENCY, Gamepad, Hand, Keyboard, Remote
from kiras_rl.deploy.runtime.mailbox import SHARED
from kiras_rl.deploy.runtime.messages import NANO, Mode, Request, State
from kiras_rl.deploy.runtime.processes import ROLES, Setup
from kiras_rl.deploy.runtime.profiles import profile_of, source_of
from kiras_rl.deploy.runtime.scripts import Script, parse_script

_DESCRIPTION = """\
Run a policy file on a robot with a gamepad, a keyboard or the robot's own remote.

  kiras-robot --sim [POLICY]     on a robot simulated in C MuJoCo at 1 kHz
  kiras-robot check POLICY       what somebody reads before a leg moves; no robot needed
  kiras-robot go1 POLICY         on a Unitree Go1 in low-level mode
  kiras-robot solo8 POLICY       on a Solo-8

Nothing moves until somebody switches the motors on. Ctrl-C lets the robot lie down and ends; a
second one damps it at once. Events are printed and kept, and every fault leaves a black box: the
last 60 s as a dataset, in the folder --out.
Exit status: 0, or 1 if a check refuses the policy or something has damped the robot, or 2 if
something was wrong with what was given.
"""
_RATE = 50.0  # Hz, of the operator
_GRACE = 10.0  # s that the robot has to lie down and end
_DEFAULT = "solo8"
_NOTICED = 0.5  # s in which the runtime finds out that the driver is gone, damps and says so
_REFUSED = 2  # exit status of a process that cannot begin


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status."""
    options = _parser().parse_args(arguments)
    try:
        kind, path = _meaning(options)
        if kind == "check":
            return _check(path)
        return Session(kind, path, options).run()
    except (PlainError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
    return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="kiras-robot",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("words", nargs="*", metavar="check|go1|solo8 POLICY", help="as above")
    add("--sim", action="store_true", help="simulate the robot of the policy")
    add("--address", default="", metavar="TEXT", help="Go1: host:port; Solo-8: network interface")
    add("--calibration", default="", metavar="FILE", help="Solo-8: angles at the encoders' index")
    add("--keyboard", action="store_true", help="take the keyboard, though there is a gamepad")
    add("--deadman", action="store_true", help="commands count while RB or R1 is held")
    add("--guest", action="store_true", help="let examples/ros2 steer while sticks and keys rest")
    add("--script", metavar="TEXT", help="instead of a hand: on,stand,walk:4:0.3,crawl:4,lie,quit")
    add("--out", type=Path, default=Path("robot_logs"), metavar="FOLDER", help="for logs")
    add("--seed", type=int, default=0, help="--sim: of how the robot lies, and of its noise (0)")
    return parser


def _meaning(options: argparse.Namespace) -> tuple[str, Path]:
    """Return what to do, and with which policy file.

    Raises:
        PolicyError: If the words make no sense.
    """
    words = list(options.words)
    kinds = ("check", "go1", "solo8")
    if options.sim:
        if len(words) > 1:
            raise PolicyError(f"--sim takes one policy file, not {' '.join(words)}")
        return "sim", Path(words[0]) if words else _shipped()
    if len(words) != 2 or words[0] not in kinds:
        given = " ".join(words) or "nothing"
        raise PolicyError(
            f"{given} was given; it takes --sim [POLICY], or one of {', '.join(kinds)} "
            "and a policy file (kiras-robot --help)"
        )
    return words[0], Path(words[1])


def _shipped() -> Path:
    """Return the policy that comes with Solo-8, where the whole project is installed."""
    path = Path(__file__).parents[3] / "robots" / _DEFAULT / "policies" / "flat.onnx"
    inside = Path(__file__).parents[2] / "robots" / _DEFAULT / "policies" / "flat.onnx"
    for candidate in (path, inside):
        if candidate.is_file():
            return candidate
    raise PolicyError("no policy comes with the onboard package: kiras-robot --sim POLICY")


def _check(path: Path) -> int:
    lines, refusals = preflight.check(path)
    for line in lines:
        print(line)
    for refusal in refusals:
        print(f"REFUSED      {refusal}")
    if not refusals:
        print("fit to run   read every line before a leg moves; hang the robot up the first time")
    return 1 if refusals else 0


class Session:
    """One run: the operator's process, which starts and ends the other two."""

    def __init__(self, kind: str, path: Path, options: argparse.Namespace) -> None:
        """Check the policy, and take the operator's seat.

        Raises:
            PolicyError: If the policy is not one for this robot.
            BusyError: If another kiras-robot runs.
        """
        policy = OnboardPolicy(path)
        self._meta: PolicyMetadata = policy.metadata
        profile = profile_of(self._meta)
        if kind not in ("sim", self._meta.base_robot):
            raise PolicyError(f"{path} is a policy of {self._meta.robot}, not of {kind}")
        refusals = preflight.refusals(policy, profile)
        if refusals:
            raise PolicyError(f"{path}: {refusals[0]}")
        self._script = parse_script(options.script, self._meta) if options.script else None
        root = Path(os.environ.get("KIRAS_ROBOT_SHARED", SHARED))
        self._channel = Channel(self._meta.base_robot, root)
        self._channel.operator.take()
        for seat in (self._channel.driver, self._channel.runtime):
            if seat.is_taken():
                seat.take()  # raises, and says who has it
        channel = self._channel
        for box in (channel.readings, channel.orders, channel.wishes, channel.guests):
            box.clear()
        self._folder = options.out / time.strftime("%Y-%m-%d_%H-%M-%S")
        self._folder.mkdir(parents=True, exist_ok=True)
        self._setup = Setup(
            policy=str(path.resolve()),
            link=kind,
            log=str((self._folder / "events.log").resolve()),
            address=options.address,
            calibration=str(Path(options.calibration).resolve()) if options.calibration else "",
            deadman=options.deadman,
            seed=options.seed,
            root=str(root),
        )
        self._by_keyboard, self._has_guest = options.keyboard, options.guest
        self._hand = Hand(self._meta)
        self._remote: Remote | None = None
        self._interrupts = self._saved = self._faults = 0
        self._state = State.OFF
        self._requests = 0
        self._driven = 0  # when the driver was last there, ns

    def run(self) -> int:
        """Run until the robot lies and the operator has left; return the exit status."""
        Path(self._setup.log).touch()
        self._told = open(self._setup.log, encoding="utf-8")  # noqa: SIM115, closed at the end
        before = signal.signal(signal.SIGINT, self._interrupt)
        try:
            with ExitStack() as stack:
                device = self._device(stack)
                print(f"{self._meta.robot}: events and black boxes in {self._folder}")
                if self._meta.onboard is None:
                    print(f"checks by the numbers of {source_of(self._meta)}")
                print(device.help)
                self._children = {role: self._start(role) for role in ROLES}
                keep_pace(lambda now: self._tick(device, now), _RATE)
        finally:
            signal.signal(signal.SIGINT, before)
            self._end()
        if any(child.returncode == _REFUSED for child in self._children.values()):
            return _REFUSED  # its line is among the events
        return 1 if self._faults else 0

    def _device(self, stack: ExitStack) -> Gamepad | Keyboard | Script:
        """Return what the operator holds: the script, a gamepad where there is one, or the keys."""
        if self._script is not None:
            return self._script
        if self._setup.link == "go1":
            self._remote = Remote()
        pad = Gamepad()
        if not self._by_keyboard and pad.poll(self._hand, 0):
            return pad
        return stack.enter_context(Keyboard())

    def _start(self, role: str) -> subprocess.Popen:
        """Start a process of its own session: the terminal's signals are the operator's."""
        words = [sys.executable, "-m", "kiras_rl.deploy.runtime.processes", role]
        return subprocess.Popen([*words, self._setup.to_json()], start_new_session=True)

    def _interrupt(self, number: int, frame: object) -> None:
        self._interrupts += 1
        if self._interrupts == 1:
            self._hand.press(Request.QUIT)
        else:
            self._hand.hold(EMERGENCY, True)

    def _tick(self, device: Gamepad | Keyboard | Script, now: int) -> bool:
        """Pass on what the operator does, print what happens; return whether all is over."""
        order, reading = self._channel.orders.get(), self._channel.readings.get()
        if order is not None:
            self._follow(State(int(order["state"])))
        if isinstance(device, Script):
            device.follow(self._state)
        connected = device.poll(self._hand, now)
        if self._remote is not None and reading is not None:
            connected |= self._remote.take(self._hand, reading["remote"].tobytes())
        guest = self._channel.guests.get() if self._has_guest else None
        wish = self._hand.wish(now, connected, guest)
        self._channel.wishes.put(wish)
        if int(wish["requests"]) != self._requests and wish["request"] == Request.SAVE:
            self._save()
        self._requests = int(wish["requests"])
        self._print_events()
        over = self._children["runtime"].poll() is not None
        if self._interrupts > 1:
            over |= reading is None or Mode(int(reading["mode"])) in (Mode.DAMP, Mode.OFF)
        if self._children["driver"].poll() is None:
            self._driven = now
        return over or now - self._driven > _NOTICED * NANO

    def _follow(self, state: State) -> None:
        if state == State.DAMPED and self._state != State.DAMPED:
            self._faults += 1
            self._save()
        self._state = state

    def _save(self) -> None:
        """Write the black box in a process of its own: it takes seconds."""
        self._saved += 1
        words = [sys.executable, "-m", "kiras_rl.deploy.runtime.command", "_save"]
        target = self._folder / f"blackbox_{self._saved}"
        given = [str(self._channel.ring), self._setup.policy, str(target), self._setup.log]
        self._writer = subprocess.Popen([*words, *given], start_new_session=True)

    def _print_events(self) -> None:
        for line in self._told:
            print(line, end="", flush=True)

    def _end(self) -> None:
        """End the children: the runtime first, for then the driver damps."""
        for role in ("runtime", "driver"):
            child = getattr(self, "_children", {}).get(role)
            if child is not None:
                child.terminate()
                child.wait(_GRACE)
        if getattr(self, "_writer", None) is not None:
            self._writer.wait()
        self._print_events()
        self._told.close()
        self._channel.operator.leave()


def write_blackbox(ring: str, policy: str, target: str, log: str) -> int:
    """Write a ring as a dataset; return the exit status."""
    events = Path(log).read_text(encoding="utf-8").splitlines()
    try:
        save(Ring(Path(ring)).rows(), OnboardPolicy(policy).metadata, Path(target), events)
        print(f"black box: {target}")
    except (OSError, ValueError) as error:
        print(f"error: black box {target}: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(write_blackbox(*sys.argv[2:]) if sys.argv[1:2] == ["_save"] else main())
