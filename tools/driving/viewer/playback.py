"""A cockpit in which a log is looked at: time can be stopped and begun again, no more."""

from __future__ import annotations

from collections.abc import Callable

from kiras_rl.dataset import Dataset
from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.tools.driving.driver import Sample
from kiras_rl.tools.driving.replay import Replay
from kiras_rl.tools.driving.viewer.cockpit import Cockpit

_ONLY_SHOWN = "a log is shown: T pauses, N goes on by a step, M slows down, R begins again"


class Playback(Cockpit):
    """Shows a log; skill and command are the log's, and what would drive says that it cannot."""

    driver: Replay

    def __init__(self, policy: OnboardPolicy, log: Dataset, title: str) -> None:
        """Show the first measurement.

        Args:
            policy: With the keyframes of the log's skills.
            log: Of `kiras_rl.tools.driving.replay.load_log`.
            title: What the log is called.

        Raises:
            RobotError: If the robot of the policy is unknown or has other joints.
        """
        super().__init__(policy, title)
        self._install(Replay(policy, log), title)
        self.notice = _ONLY_SHOWN

    def advance(self, after_substep: Callable[[], None] | None = None) -> Sample | None:
        """Show the next control period, unless time stands still; at the end it does."""
        if self.driver.is_over:
            self.paused = True
        sample = super().advance(after_substep)
        if sample is not None:
            self.skill, self.target = sample.skill, sample.command
            self.notice = self.driver.situation
        return sample

    def reset(self) -> None:
        """Begin again."""
        self.driver.reset(0)
        self.telemetry.clear()
        self.paused = False

    def choose_skill(self, skill: str | int) -> None:
        """Say that a log cannot be driven."""
        self.notice = _ONLY_SHOWN

    def set_target(self, axis: int, value: float) -> None:
        """Say that a log cannot be driven."""
        self.notice = _ONLY_SHOWN

    def hold(self, axis: int, direction: float, seconds: float) -> None:
        """Say that a log cannot be driven."""
        self.notice = _ONLY_SHOWN

    def stop(self) -> None:
        """Say that a log cannot be driven."""
        self.notice = _ONLY_SHOWN

    def push(self) -> None:
        """Say that a log cannot be driven."""
        self.notice = _ONLY_SHOWN

    def load(self, policy: OnboardPolicy, title: str) -> None:
        """Say that a log cannot be driven."""
        self.notice = _ONLY_SHOWN

    def choose_tile(self, **changes: str | int) -> None:
        """Say that a log has no ground."""
        self.notice = _ONLY_SHOWN
