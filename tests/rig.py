"""A simulated robot, its driver, the runtime and a hand at the buttons, on a clock of their own."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np

from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.deploy.runtime.blackbox import Ring
from kiras_rl.deploy.runtime.driver import Channel, Driver, Link
from kiras_rl.deploy.runtime.machine import Runtime
from kiras_rl.deploy.runtime.messages import NANO, WISH, Mode, Request, State
from kiras_rl.deploy.runtime.profiles import profile_of
from kiras_rl.deploy.runtime.simulated import Plant, SimulatedRobot
from kiras_rl.robots.robot import ROBOTS

START = 1_000 * NANO


def shipped(robot: str) -> Path:
    return ROBOTS / robot / "policies" / "flat.onnx"


class Rig:
    """Everything of one robot in one process; time passes only in `run`.

    Attributes:
        log: Lines of the runtime.
        now: ns.
        wish: What the hand does; edit it.
        stopped: Whether the runtime does not run: a process that is stopped.
    """

    def __init__(
        self,
        robot: str,
        folder: Path,
        seed: int = 0,
        wrap: Callable[[Link], Link] = lambda link: link,
        world: Callable[[Rig], Link] | None = None,
    ) -> None:
        self.policy = OnboardPolicy(shipped(robot))
        self.profile = profile_of(self.policy.metadata)
        self.plant = Plant(self.policy.metadata, self.profile, seed)
        self.channel = Channel(robot, folder)
        self.channel.runtime.take()
        self.electronics = None  # what stands between the wire and the plant
        made = world(self) if world else SimulatedRobot(self.plant, self.profile.rate)
        self.link = wrap(made)
        self.ring = Ring(self.channel.ring, round(60 * self.profile.rate))
        self.log: list[str] = []
        self.driver = Driver(self.link, self.channel, self.ring, self.log.append)
        self.runtime = Runtime(self.policy, self.profile, self.log.append)
        self.wish = np.zeros((), WISH)
        self.wish["connected"] = self.wish["held"] = 1
        self.now, self.stopped, self.silent = START, False, False
        self.order_delay = self.jump = 0  # ns
        self._late: deque[tuple[int, np.ndarray]] = deque()
        self._tick = 0
        self.modes: list[Mode] = []
        self.speed = self.torque = 0.0

    def run(self, seconds: float) -> None:
        period = round(NANO / self.profile.rate)
        each = round(self.profile.rate / self.policy.metadata.control_rate)
        for _ in range(round(seconds * self.profile.rate)):
            if self._tick % each == 0:
                self._hand()
                self._run_runtime()
            while self._late and self._late[0][0] <= self.now:
                self.channel.orders.put(self._late.popleft()[1])
            if self.electronics is not None:
                self.electronics.step(self.now)
            self.driver.tick(self.now)
            self.modes.append(self.driver.mode)
            self.speed = max(self.speed, float(np.linalg.norm(self.plant.data.qvel[:3])))
            self.torque = max(self.torque, float(np.abs(self.plant.torque).max()))
            self._tick += 1
            self.now += period + self.jump
            self.jump = 0

    def run_until(self, state: State, most: float = 20.0) -> None:
        for _ in range(round(most / 0.02)):
            if self.runtime.state == state:
                return
            self.run(0.02)
        raise AssertionError(f"no {state.name} after {most} s: {self.log}")

    def press(self, request: Request) -> None:
        self.wish["request"] = request
        self.wish["requests"] += 1

    def walk(self, skill: str = "walk", command: tuple[float, float, float] = (0.0, 0.0, 0.0)):
        """Go from where it lies to the policy."""
        if self.runtime.state == State.OFF:
            self.run(0.8)
            self.press(Request.ACKNOWLEDGE)
        self.run_until(State.LYING)
        self.press(Request.STAND)
        self.run_until(State.STANDING)
        self.run(0.4)
        self.press(Request.WALK)
        self.run_until(State.POLICY, 1.0)
        self.drive(skill, command)

    def drive(self, skill: str, command: tuple[float, float, float]) -> None:
        self.wish["skill"] = self.policy.metadata.skills.index(skill)
        self.wish["command"] = command

    @property
    def height(self) -> float:
        return float(self.plant.data.qpos[2])

    def _hand(self) -> None:
        if not self.silent:
            self.wish["seq"] += 1
            self.wish["time"] = self.now
            self.channel.wishes.put(self.wish)

    def _run_runtime(self) -> None:
        if self.stopped:
            return
        reading, wish = self.channel.readings.get(), self.channel.wishes.get()
        order = self.runtime.tick(reading, wish, self.now)
        self._late.append((self.now + self.order_delay, order))
