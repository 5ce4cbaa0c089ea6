"""The runtime's state machine: readings and wishes in, orders out, one call a control period.

Letters: J joints.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from kiras_rl.deploy.policy import OnboardPolicy, PolicyError, projected_gravity
from kiras_rl.deploy.profile import Profile
from kiras_rl.deploy.runtime.checks import Checks, Severity, View
from kiras_rl.deploy.runtime.messages import NANO, ORDER, Flag, Mode, Request, State
from kiras_rl.deploy.runtime.motion import Path

VALID = 2.0  # control periods that an order counts
STEADY = 0.5  # s without a finding before motors may be switched on, and before the robot may rise
FADE = 1.0  # s in which the gains of a robot that lies down go to zero
FIRST = 0.5  # s that the policy drives the posture in which it took over
ACCELERATION = np.array([1.0, 1.0, 2.0])  # of commands, m/s^2, m/s^2, rad/s^2
SILENT = 0.5  # s without the operator: the command goes to zero
LOST = 2.0  # s without the operator: the robot lies down
LEAD = 0.2  # rad that a slow move may begin away from where a joint is


class Runtime:
    """Decides what the robot does; `tick` has to be called at the policy's control rate.

    Attributes:
        state: Where it is.
        skill: Index of the skill that is driven.
        command: v_x, v_y in m/s and yaw rate in rad/s that are driven, (3,).
        misses: Late ticks since the start.
        fault: Name of the check that damped the robot; empty if none did.
        finished: Whether the operator has ended it, and the robot lies.
    """

    def __init__(
        self,
        policy: OnboardPolicy,
        profile: Profile,
        log: Callable[[str], object],
        deadman: bool = False,
    ) -> None:
        """Begin in State.OFF.

        Args:
            policy: What drives.
            profile: Of its robot.
            log: Takes a line whenever something happens.
            deadman: Whether a button has to be held for a command to count.
        """
        self._policy, self._profile, self._log, self._deadman = policy, profile, log, deadman
        meta = policy.metadata
        self._checks = Checks(meta, profile)
        self._period = round(NANO / meta.control_rate)
        self._poses = [np.array(meta.keyframes[skill].joint_pos) for skill in meta.skills]
        pitches = [meta.keyframes[skill].pitch for skill in meta.skills]
        self._gravity = np.array([_gravity_at(pitch) for pitch in pitches])
        heights = [meta.keyframes[skill].base_height for skill in meta.skills]
        self._low = self._poses[int(np.argmin(heights))]
        self._bounds = np.array([vars(meta.command_range)[axis] for axis in _AXES]).T
        self._kp, self._kd = np.array(meta.kp), np.array(meta.kd)
        self._target = np.zeros(meta.num_joints)
        self._path: Path | None = None
        self._since = self._steady = self._before = 0
        self._requests = self._seq = self._row = 0
        self._previous = 0
        self._seen: int | None = None
        self._told: set[str] = set()
        self._quits = self._calibrates = self._waits = False
        self._share = 1.0
        self.state, self.skill, self.command = State.OFF, 0, np.zeros(3)
        self.misses, self.fault, self.finished = 0, "", False

    def tick(self, reading: np.ndarray | None, wish: np.ndarray | None, now: int) -> np.ndarray:
        """Return the order for the next control period.

        Args:
            reading: The newest READING, or None if there was none yet.
            wish: The newest WISH, or None if there was none yet.
            now: ns.
        """
        self._count_misses(now)
        if reading is not None:
            self._enter(State.CONNECTED, now) if self.state == State.OFF else None
            self._judge(reading, wish, now)
            self._take(reading, wish, now)
        return self._order(self._act(reading, now) if reading is not None else Mode.OFF, now)

    # --- judging ---------------------------------------------------------------------------------

    def _count_misses(self, now: int) -> None:
        late = bool(self._before) and now - self._before > 1.5 * self._period
        self._row = self._row + 1 if late else 0
        self.misses += late
        self._before = now

    def _view(self, reading: np.ndarray, now: int) -> View:
        driven = self.state == State.POLICY
        gravity = self._gravity[[self.skill, self._previous]] if driven else self._gravity
        return View(reading, self.state, now, self._target, gravity, self._row)

    def _judge(self, reading: np.ndarray, wish: np.ndarray | None, now: int) -> None:
        """Run the checks, and follow the gravest finding."""
        findings = self._checks.run(self._view(reading, now))
        self._tell({f"{found.name}: {found.text}": found.name for found in findings})
        grave = findings[0] if findings else None
        if grave is None or grave.severity == Severity.WARN:
            self._steady = self._steady or now
        else:
            self._steady = 0
        if _is_pressed(reading, wish):
            self._damp("emergency", "somebody pressed the button", now)
        elif grave is not None and grave.severity == Severity.DAMP:
            self._damp(grave.name, grave.text, now)
        elif grave is not None and grave.severity == Severity.LOWER:
            self._lower(now, grave.name)

    def _tell(self, lines: dict[str, str]) -> None:
        """Log findings that were not there in the tick before."""
        for line, name in lines.items():
            if name not in self._told:
                self._log(line)
        self._told = set(lines.values())

    def _damp(self, name: str, text: str, now: int) -> None:
        if self.state in (State.OFF, State.CONNECTED, State.DAMPED):
            return  # nothing moves
        self._log(f"damped by {name}: {text}")
        self.fault = name
        self._enter(State.DAMPED, now)

    def _lower(self, now: int, why: str) -> None:
        if self.state in (State.RISING, State.STANDING, State.POLICY):
            self._log(f"lies down: {why}")
            self._enter(State.LOWERING, now)

    # --- the operator ----------------------------------------------------------------------------

    def _take(self, reading: np.ndarray, wish: np.ndarray | None, now: int) -> None:
        """Follow the operator: requests, skill, command; or the lack of one."""
        here = wish if wish is not None and wish["connected"] else None
        if here is not None and self._seen is None:
            self._requests = int(here["requests"])  # pressed before this runtime began
        if here is not None:
            self._seen = max(self._seen or 0, int(here["time"]))
        silence = (now - self._seen) / NANO if self._seen is not None else np.inf
        heard = here if silence <= SILENT else None
        self._steer(heard)
        if silence > LOST:
            self._lower(now, "the operator is lost")
        if heard is not None and int(heard["requests"]) != self._requests:
            self._requests = int(heard["requests"])
            self._answer(Request(int(heard["request"])), reading, now)

    def _steer(self, wish: np.ndarray | None) -> None:
        """Bring the command towards the operator's, within its range."""
        wanted = np.zeros(3)
        if wish is not None and (wish["held"] or not self._deadman):
            wanted = np.nan_to_num(wish["command"].astype(np.float64))
        wanted = np.clip(wanted, *self._bounds) if self.state == State.POLICY else np.zeros(3)
        step = ACCELERATION * self._period / NANO
        self.command = self.command + np.clip(wanted - self.command, -step, step)
        begun = self.state == State.POLICY and self._before - self._since > FIRST * NANO
        if wish is not None and begun and wish["skill"] < len(self._poses):
            skill = int(wish["skill"])
            if skill != self.skill:
                self._previous, self.skill = self.skill, skill
                self._log(f"skill {self._policy.metadata.skills[skill]}")

    def _answer(self, request: Request, reading: np.ndarray, now: int) -> None:
        """Do what the operator asks for, or say why not."""
        state = self.state
        if request == Request.ACKNOWLEDGE and state in (State.CONNECTED, State.DAMPED):
            self._switch_on(reading, now)
        elif request == Request.STAND and state in (State.LYING, State.POLICY, State.LOWERING):
            why = self._checks.refusal(self._view(reading, now)) if state == State.LYING else ""
            self._refuse("stand up", why) if why else self._enter(State.RISING, now, reading)
        elif request == Request.LIE and state in (State.RISING, State.STANDING, State.POLICY):
            self._enter(State.LOWERING, now, reading)
        elif request == Request.WALK and state == State.STANDING:
            self._start_policy(reading, now)
        elif request == Request.QUIT:
            self._quits = True
            self._lower(now, "the operator leaves")
        elif request not in (Request.SAVE, Request.NONE):
            self._refuse(request.name.lower(), f"not possible while {state.name.lower()}")

    def _refuse(self, what: str, why: str) -> None:
        self._log(f"refused to {what}: {why}")

    def _switch_on(self, reading: np.ndarray, now: int) -> None:
        if not self._steady or now - self._steady < STEADY * NANO:
            missing = ", ".join(sorted(self._told)) or f"wait {STEADY} s"
            self._refuse("switch the motors on", missing)
            return
        known = reading["flags"] & Flag.CALIBRATED or not self._profile.needs_calibration
        self._calibrates = not known
        if self._calibrates:
            self._log("calibrates: the joints move a little")
        if self.state == State.DAMPED:
            self.fault = ""
        self._enter(State.CONNECTED if self._calibrates else State.CALIBRATED, now)

    def _start_policy(self, reading: np.ndarray, now: int) -> None:
        """Give the joints to the policy if it can take them without a jump."""
        why = self._why_not_walk(reading)
        if why:
            self._refuse("walk", why)
        else:
            self._enter(State.POLICY, now)

    def _why_not_walk(self, reading: np.ndarray) -> str:
        joints, most = len(self._kp), self._profile
        error = np.abs(reading["joint_pos"][:joints] - self._poses[0])
        if error.max() > most.takeover_joint:
            name = self._policy.metadata.joint_names[int(np.argmax(error))]
            off = f"{name} is {error.max():.2f} rad off its posture"
            return f"{off}, {most.takeover_joint} are allowed"
        gravity = projected_gravity(reading["quat"].astype(np.float64))
        tilt = np.rad2deg(np.arccos(np.clip(gravity @ self._gravity[0], -1.0, 1.0)))
        if tilt > most.takeover_tilt:
            return f"tilted by {tilt:.0f} degrees, {most.takeover_tilt:.0f} are allowed"
        self._policy.reset(self._target)
        first = self._drive(reading, 0)
        jump = float(np.abs(first - self._target).max())
        self._policy.reset(self._target)
        if jump <= most.takeover_target:
            return ""
        return f"its first target is {jump:.2f} rad away, {most.takeover_target} are allowed"

    # --- acting ----------------------------------------------------------------------------------

    def _enter(self, state: State, now: int, reading: np.ndarray | None = None) -> None:
        self._log(f"{self.state.name.lower()} -> {state.name.lower()}")
        self.state, self._since, self._path = state, now, None
        if state == State.POLICY:
            self.skill = self._previous = 0
        if state != State.POLICY:
            self.command = np.zeros(3)
        if state == State.CALIBRATED:
            self._steady = 0

    def _act(self, reading: np.ndarray, now: int) -> Mode:
        """Do what the state does, and return what the motors shall do."""
        age = (now - self._since) / NANO
        if self.state == State.CONNECTED:
            return self._connected(reading, now)
        if self.state == State.CALIBRATED:
            return self._calibrated(reading, now)
        if self.state in (State.RISING, State.LOWERING):
            return self._move(reading, age, now)
        if self.state == State.POLICY:
            return self._walk(reading, now)
        if self.state == State.STANDING:
            return Mode.SERVO
        self.finished = self._quits
        return Mode.DAMP

    def _connected(self, reading: np.ndarray, now: int) -> Mode:
        self.finished = self._quits
        if self._calibrates and reading["flags"] & Flag.CALIBRATED:
            self._calibrates = False
            self._enter(State.CALIBRATED, now)
            return Mode.DAMP
        return Mode.CALIBRATE if self._calibrates else Mode.OFF

    def _calibrated(self, reading: np.ndarray, now: int) -> Mode:
        """Wait until nothing speaks against rising."""
        why = self._checks.refusal(self._view(reading, now))
        if why and not self._waits:
            self._log(f"not ready: {why}")
        self._waits = bool(why)
        if why:
            self._steady = now
        elif now - max(self._steady, self._since) > STEADY * NANO:
            self._enter(State.LYING, now)
        self.finished = self._quits
        return Mode.DAMP

    def _move(self, reading: np.ndarray, age: float, now: int) -> Mode:
        """Follow a slow path to the standing posture, or down to the lowest one."""
        rises = self.state == State.RISING
        if self._path is None:
            here = reading["joint_pos"][: len(self._kp)].astype(np.float64)
            held = np.clip(self._target - here, -LEAD, LEAD) if self._was_loaded(reading) else 0.0
            goals = [self._low, self._poses[0]] if rises and not np.any(held) else [self._poses[0]]
            self._path = Path([here + held, *(goals if rises else [self._low])])
        self._target = self._path.at(age)
        left = age - self._path.duration
        if rises and left > 0:
            self._enter(State.STANDING, now)
        elif not rises and left > FADE:
            self._enter(State.LYING, now)
            return Mode.DAMP
        self._share = 1.0 if rises else float(np.clip(1.0 - left / FADE, 0.0, 1.0))
        return Mode.SERVO

    def _was_loaded(self, reading: np.ndarray) -> bool:
        """Whether the joints carry the robot by their targets now."""
        return Mode(int(reading["mode"])) in (Mode.SERVO, Mode.HOLD)

    def _walk(self, reading: np.ndarray, now: int) -> Mode:
        try:
            if self._since == now:
                self._policy.reset(self._target)
            asked = self._drive(reading, self.skill)
        except PolicyError as error:
            self._damp("policy", str(error), now)
            return Mode.DAMP
        step = self._profile.slew * np.array(self._policy.metadata.action_scale)
        self._target = self._target + np.clip(asked - self._target, -step, step)
        return Mode.SERVO

    def _drive(self, reading: np.ndarray, skill: int) -> np.ndarray:
        joints = len(self._kp)
        return self._policy.step(
            joint_pos=reading["joint_pos"][:joints],
            joint_vel=reading["joint_vel"][:joints],
            imu_quat=reading["quat"],
            base_ang_vel=reading["gyro"],
            command=self.command,
            skill=skill,
        )

    def _order(self, mode: Mode, now: int) -> np.ndarray:
        order = np.zeros((), ORDER)
        self._seq += 1
        share = self._share if self.state == State.LOWERING else 1.0
        joints = len(self._kp)
        order["seq"], order["time"], order["mode"] = self._seq, now, mode
        order["valid_until"] = now + round(VALID * self._period)
        order["state"], order["skill"], order["command"] = self.state, self.skill, self.command
        if mode == Mode.SERVO:
            order["target"][:joints] = self._target
            order["kp"][:joints], order["kd"][:joints] = share * self._kp, self._kd
        return order


_AXES = ("lin_vel_x", "lin_vel_y", "ang_vel_z")


def _gravity_at(pitch: float) -> np.ndarray:
    """Gravity's direction in the base frame at a pitch, nose down positive, rad. (3,)."""
    return np.array([np.sin(pitch), 0.0, -np.cos(pitch)])


def _is_pressed(reading: np.ndarray, wish: np.ndarray | None) -> bool:
    by_remote = bool(int(reading["flags"]) & Flag.EMERGENCY)
    return by_remote or (wish is not None and bool(wish["emergency"]))
