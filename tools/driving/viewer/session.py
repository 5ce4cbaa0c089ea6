"""The loop around a cockpit: real time, policies that come and go, a gamepad."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from kiras_rl.config import ConfigError
from kiras_rl.robots.robot import RobotError
from kiras_rl.tools.driving.viewer.choices import RUNS, list_choices, terrain_selectors, title_of
from kiras_rl.tools.driving.viewer.clock import Clock
from kiras_rl.tools.driving.viewer.cockpit import Cockpit
from kiras_rl.tools.driving.viewer.gamepad import NAMES, Gamepad
from kiras_rl.tools.driving.viewer.loader import Follower, Loader
from kiras_rl.tools.driving.viewer.view import Selector, View


class Session:
    """Runs a cockpit until it is closed.

    Attributes:
        cockpit: What is driven.
        view: What a screen needs to know besides.
    """

    def __init__(
        self,
        cockpit: Cockpit,
        show: Callable[[], None],
        view: View,
        follow: Path | None = None,
        runs: Path = RUNS,
    ) -> None:
        """Get ready.

        Args:
            cockpit: What is driven.
            show: Is called after every step, in slow motion after every physics step.
            view: Is told about the clock and the gamepad, and gets the lists to choose from.
            follow: Run whose checkpoints are loaded as they appear.
            runs: Folder of runs to choose from.

        Raises:
            PolicyError: If what is to be followed is not a run.
        """
        self.cockpit, self.view, self._show = cockpit, view, show
        self._run = follow
        self._follower = None if follow is None else Follower(follow, time.monotonic)
        self._loader, self._clock, self._gamepad = Loader(), Clock(), Gamepad(cockpit)
        self._closed = False
        choices = list_choices(runs)
        titles = [choice.title for choice in choices]
        self.view.selectors.append(
            Selector(
                "policy",
                heading="Robot and policy",
                options=lambda: titles,
                current=lambda: cockpit.title,
                choose=lambda index: cockpit.post(self._choose, choices[index].path, titles[index]),
            )
        )
        self.view.selectors += terrain_selectors(cockpit)

    def run(self, seconds: float = float("inf")) -> None:
        """Go on until closed, or for some seconds of the world."""
        end = time.monotonic() + seconds
        try:
            while not self._closed and time.monotonic() < end:
                self._look_around()
                self._step()
        finally:
            self._loader.close()
            self._gamepad.close()

    def close(self) -> None:
        """End the loop after the step that it is in."""
        self._closed = True

    def _step(self) -> None:
        cockpit = self.cockpit
        period = 1 / cockpit.driver.metadata.control_rate / cockpit.speed
        if cockpit.speed < 1:
            cockpit.advance(after_substep=lambda: self._show_and_wait(period / self._substeps))
        else:
            cockpit.advance()
            self._show_and_wait(period)
            return
        if cockpit.paused:
            self._show_and_wait(period)

    def _show_and_wait(self, seconds: float) -> None:
        self._show()
        self._clock.wait(seconds)
        self.view.real_time = self._clock.real_time

    @property
    def _substeps(self) -> int:
        return self.cockpit.driver.substeps

    def _look_around(self) -> None:
        """See to the gamepad, to new checkpoints and to policies that have been loaded."""
        self._gamepad.poll()
        self.view.gamepad = f"gamepad: {NAMES}" if self._gamepad.connected else ""
        checkpoint = self._follower.poll() if self._follower else None
        if checkpoint and self._run:
            self._loader.request(checkpoint, title_of(self._run))
        loaded = self._loader.poll()
        if loaded is None:
            return
        if loaded.policy is None:
            self.cockpit.notice = loaded.error
            return
        try:
            self.cockpit.load(loaded.policy, loaded.title)
        except (RobotError, ConfigError) as error:
            self.cockpit.notice = str(error)
        else:
            self.cockpit.notice = f"loaded at {time.strftime('%H:%M:%S')}"

    def _choose(self, path: Path, title: str) -> None:
        self.cockpit.notice = f"loading {title} ..."
        self._follower = None  # whoever chooses does not want the next checkpoint
        self._loader.request(path, title)
