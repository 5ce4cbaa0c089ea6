"""A hand that follows a script: what tests, long runs and rehearsals drive with."""

from __future__ import annotations

from dataclasses import dataclass

from kiras_rl.deploy.errors import PlainError
from kiras_rl.deploy.metadata import PolicyMetadata
from kiras_rl.deploy.runtime.hands import HELD, Hand
from kiras_rl.deploy.runtime.messages import NANO, Request, State

WAIT = 1.0  # s in a state before the next step, so that checks have seen it
_WORDS = {
    "on": (Request.ACKNOWLEDGE, State.LYING),
    "stand": (Request.STAND, State.STANDING),
    "lie": (Request.LIE, State.LYING),
    "quit": (Request.QUIT, None),
    "save": (Request.SAVE, None),
}


class ScriptError(PlainError, ValueError):
    """A script that makes no sense; the message says why."""


@dataclass(frozen=True)
class Step:
    """One step: a request and the state that it ends in, or a skill that is driven for a time."""

    request: Request = Request.NONE
    ends_in: State | None = None
    skill: int = 0
    seconds: float = 0.0
    command: tuple[float, float, float] = (0.0, 0.0, 0.0)


def parse_script(text: str, metadata: PolicyMetadata) -> Script:
    """Read a script: on, stand, lie, save, quit, or skill[:seconds[:v_x[:v_y[:yaw_rate]]]].

    Raises:
        ScriptError: If a word is none of these.
    """
    return Script([_parse(word.strip(), metadata) for word in text.split(",")])


def _parse(word: str, metadata: PolicyMetadata) -> Step:
    if word in _WORDS:
        return Step(*_WORDS[word])
    skill, *numbers = word.split(":")
    try:
        seconds, *command = [float(number) for number in numbers] or [4.0]
        index = metadata.skills.index(skill)
    except ValueError:
        known = ", ".join((*_WORDS, *metadata.skills))
        raise ScriptError(
            f"--script: '{word}' is none of {known}, a skill with :seconds:v_x:v_y:yaw_rate"
        ) from None
    if len(command) > 3:
        raise ScriptError(f"--script: '{word}' has more than seconds, v_x, v_y and yaw rate")
    v_x, v_y, yaw_rate = (*command, 0.0, 0.0, 0.0)[:3]
    return Step(Request.WALK, None, index, seconds, (v_x, v_y, yaw_rate))


class Script:
    """Presses the buttons of its steps, one after the other."""

    help = "a script drives; Ctrl-C lie down, leave"

    def __init__(self, steps: list[Step]) -> None:
        """Begin before the first step."""
        self._steps = steps
        self._index = -1
        self._since: int | None = None
        self._pressed = 0
        self._state = self._before = State.OFF

    def follow(self, state: State) -> None:
        """Learn where the runtime is."""
        self._state = state

    def poll(self, hand: Hand, now: int) -> bool:
        """Do what is due; return that the operator is there."""
        hand.hold(HELD, True)
        if self._is_done(now):
            self._index += 1
            self._since = None
            self._before = self._state
        elif self._since is None and now - self._pressed > WAIT * NANO:
            self._press(hand, now)
        return True

    def _press(self, hand: Hand, now: int) -> None:
        """Press the step's button, again every WAIT until it has done something."""
        moves = self._state != self._before and self._state != State.POLICY
        if self._state == State.DAMPED:  # what follows was meant for a robot that stands
            self._steps, self._index = [Step(Request.QUIT)], 0
        elif self._index >= len(self._steps) or moves:
            return
        step = self._steps[self._index]
        self._pressed = now
        if step.request != Request.WALK:
            hand.press(step.request)
            self._since = now if step.ends_in is None else None
        elif self._state == State.POLICY:
            hand.choose(step.skill)
            hand.set_command(step.command)
            self._since = now
        else:
            hand.press(Request.WALK)

    def _is_done(self, now: int) -> bool:
        if self._index < 0:
            return self._state != State.OFF
        if self._index >= len(self._steps):
            return False
        step = self._steps[self._index]
        if step.request == Request.WALK or step.ends_in is None:
            return self._since is not None and now - self._since >= step.seconds * NANO
        return self._state == step.ends_in and now - self._pressed > 0.1 * NANO
