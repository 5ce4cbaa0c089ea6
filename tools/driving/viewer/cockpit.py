"""A drive by hand without a screen: commands, skills, time, falls; page and terminal share it."""

from __future__ import annotations

import queue
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from kiras_rl.config import ConfigError
from kiras_rl.deploy.policy import OnboardPolicy, PolicyError
from kiras_rl.tools.driving.driver import Driver, Sample
from kiras_rl.tools.driving.ground import FLAT, Terrain, Tile, terrain_of
from kiras_rl.tools.driving.viewer.telemetry import Telemetry

AXES = ("v_x", "v_y", "yaw rate")
FORWARD, LEFT, YAW = range(3)
SPEEDS = (1.0, 0.5, 0.25, 0.1)
"""Times real time, in the order in which slow motion goes through them."""

FALL_SECONDS = 1.0  # on the ground before it is put back: long enough to see what happened
_RAMP = np.array([0.5, 0.5, 1.5])  # of the target while a key is held, m/s or rad/s in a second
_SLEW = np.array([1.5, 1.5, 4.0])  # of the command behind its target: no jumps for the policy


class Cockpit:
    """What a driver's hands can do to one simulated robot.

    Every method belongs to the thread that calls `advance`; another thread uses `post`, which lets
    the next `advance` do it.

    Attributes:
        driver: The robot and its policy.
        title: What the policy is called.
        telemetry: The last seconds, for plots.
        target: Command that is asked for: v_x, v_y and yaw rate, (3,), m/s and rad/s.
        command: What the policy is given: the target, approached without jumps, (3,).
        limits: Lowest and highest command that the policy was trained for, (3, 2).
        skill: Index of the skill that is asked for.
        speed: Times real time.
        push_speed: Velocity that a push adds, m/s.
        pushes: How often it was pushed.
        falls: How often it had to be put back.
        crossings: How often it came to the end of its tile, and started again in the middle.
        notice: The last thing worth telling, or an empty text.
    """

    def __init__(
        self,
        policy: OnboardPolicy,
        title: str = "policy",
        seed: int = 0,
        tile: Tile = FLAT,
    ) -> None:
        """Stand in the first skill's posture, commanded to stand.

        Args:
            policy: What drives.
            title: What it is called.
            seed: Of the directions of pushes.
            tile: The ground to start on.

        Raises:
            RobotError: If the robot of the policy is unknown or has other joints.
            ConfigError: If there is no such tile.
        """
        self._inbox: queue.SimpleQueue[tuple[Callable[..., Any], tuple]] = queue.SimpleQueue()
        self._generator = np.random.default_rng(seed)
        self.paused, self._single_step = False, False
        self.speed, self.push_speed = SPEEDS[0], 0.5
        self.pushes, self.falls, self.crossings, self.notice = 0, 0, 0, ""
        self.skill = 0
        self._install(_drive(policy, terrain_of(policy.metadata), tile), title)

    def _install(self, driver: Driver, title: str) -> None:
        meta = driver.metadata
        ranges = meta.command_range
        self.driver, self.title = driver, title
        self.limits = np.array([ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_z])
        self.telemetry = Telemetry(meta.control_rate)
        self.target, self.command = np.zeros(3), np.zeros(3)
        self._held, self._direction = np.zeros(3), np.zeros(3)  # s that are left; -1, 0 or 1
        self._down = 0.0  # s that the robot has been lying

    # --- what other threads do -------------------------------------------------------------------

    def post(self, method: Callable[..., Any], *arguments: Any) -> None:
        """Let the next `advance` call a method, such as `cockpit.post(cockpit.push)`."""
        self._inbox.put((method, arguments))

    # --- skills and commands ---------------------------------------------------------------------

    @property
    def skills(self) -> tuple[str, ...]:
        """Names of the policy's skills."""
        return self.driver.metadata.skills

    def choose_skill(self, skill: str | int) -> None:
        """Ask for a skill, by name or index.

        Raises:
            PolicyError: If the policy has no such skill.
        """
        self.driver.set_task(skill, self.command)
        self.skill = self.driver.policy.skill_index(skill)

    def set_target(self, axis: int, value: float) -> None:
        """Ask for a velocity along one axis, within its limits; m/s or rad/s."""
        self.target[axis] = np.clip(value, *self.limits[axis])
        self._held[axis] = 0.0

    def set_share(self, axis: int, share: float) -> None:
        """Ask for a share of what an axis allows, -1 to 1: a joystick's deflection."""
        low, high = self.limits[axis]
        self.set_target(axis, share * (high if share > 0 else -low))

    def hold(self, axis: int, direction: float, seconds: float) -> None:
        """Hold a key: its axis goes up or down until it is let go.

        The forward velocity then stays where it is, the others spring back to zero.

        Args:
            axis: `FORWARD`, `LEFT` or `YAW`.
            direction: 1 or -1.
            seconds: How long without another call until the key counts as let go.
        """
        self._held[axis], self._direction[axis] = seconds, direction

    def stop(self) -> None:
        """Ask for standing still."""
        self.target[:] = 0.0
        self._held[:] = 0.0

    # --- the robot -------------------------------------------------------------------------------

    def push(self) -> None:
        """Add `push_speed` to the base, in a random horizontal direction."""
        self.pushes += 1
        angle = self._generator.uniform(0, 2 * np.pi)
        self.driver.push(self.push_speed * np.array([np.cos(angle), np.sin(angle), 0.0]))

    def reset(self) -> None:
        """Put the robot at rest into the posture of the chosen skill, standing."""
        self.stop()
        self.command[:] = 0.0
        self._down = 0.0
        self.driver.set_task(self.skill, self.command)
        self.driver.reset(self.skill)

    def load(self, policy: OnboardPolicy, title: str) -> None:
        """Drive with another policy; with the same robot, skills and ground, in full stride.

        The tile stays as long as the policy's terrain has it.

        Raises:
            RobotError: If the robot of the policy is unknown or has other joints.
            ConfigError: If its terrain cannot be made.
        """
        old, terrain = self.driver, terrain_of(policy.metadata)
        if terrain.config == self.terrain.config:
            terrain = self.terrain  # its tiles are made
        driver = _drive(policy, terrain, terrain.nearest(old.tile))
        target, command, telemetry = self.target, self.command, self.telemetry
        same = old.metadata.skills == policy.metadata.skills and old.scene == driver.scene
        self._install(driver, title)
        if same:
            driver.take_over(old)
            self.target = np.clip(target, *self.limits.T)
            self.command, self.telemetry = command, telemetry
            driver.set_task(self.skill, command)
        else:
            self.skill = 0
            self.reset()

    # --- the ground ------------------------------------------------------------------------------

    @property
    def terrain(self) -> Terrain:
        """The tiles to choose from."""
        return self.driver.terrain

    @property
    def tile(self) -> Tile:
        """The ground that the robot is on."""
        return self.driver.tile

    def choose_tile(self, **changes: str | int) -> None:
        """Put another tile under the robot, which then stands in its middle.

        Args:
            changes: What is to be other than now: `kind`, `level` or `variant`.
        """
        tile = replace(self.tile, **changes)
        if tile.is_flat and self.tile.is_flat:
            self.notice = "flat ground has neither levels nor variants: choose a terrain first"
            return
        try:
            self.driver.show(tile.kind, tile.level, tile.variant)
        except ConfigError as error:
            self.notice = str(error)
        else:
            self.reset()

    def next_terrain(self) -> None:
        """Go on to the next type of terrain."""
        kinds = self.terrain.kinds
        self.choose_tile(kind=kinds[(kinds.index(self.tile.kind) + 1) % len(kinds)])

    def raise_level(self) -> None:
        """Make the terrain more difficult, up to its top level."""
        self._change_level(1)

    def lower_level(self) -> None:
        """Make the terrain easier, down to its lowest level."""
        self._change_level(-1)

    def _change_level(self, change: int) -> None:
        level = int(np.clip(self.tile.level + change, 0, self.terrain.levels - 1))
        if self.tile.is_flat or level != self.tile.level:
            self.choose_tile(level=level)

    def next_variant(self) -> None:
        """Go on to the next tile of the same type and level."""
        self.choose_tile(variant=(self.tile.variant + 1) % self.terrain.variants)

    # --- time ------------------------------------------------------------------------------------

    def toggle_pause(self) -> None:
        """Stop time, or let it go on."""
        self.paused = not self.paused

    def single_step(self) -> None:
        """Pause, and run one control step."""
        self.paused = self._single_step = True

    def set_speed(self, speed: float) -> None:
        """Let time run at a part of real time."""
        self.speed = float(np.clip(speed, min(SPEEDS), max(SPEEDS)))

    def next_speed(self) -> None:
        """Go on to the next of `SPEEDS`, and from the slowest back to real time."""
        slower = [speed for speed in SPEEDS if speed < self.speed]
        self.speed = slower[0] if slower else SPEEDS[0]

    def advance(self, after_substep: Callable[[], None] | None = None) -> Sample | None:
        """Do what was posted, then run one control step, unless time stands still.

        Args:
            after_substep: As in `Driver.step`.

        Returns:
            What happened, or None while paused.
        """
        while not self._inbox.empty():
            method, arguments = self._inbox.get()
            try:
                method(*arguments)
            except PolicyError as error:  # a key for a skill of the policy before
                self.notice = str(error)
        if self.paused and not self._single_step:
            return None
        self._single_step = False
        dt = 1 / self.driver.metadata.control_rate
        self._move_target(dt)
        self.command += np.clip(self.target - self.command, -_SLEW * dt, _SLEW * dt)
        self.driver.set_command(self.command)
        sample = self.driver.step(after_substep)
        self.telemetry.add(sample, self.driver.posture, self.driver.policy.velocity)
        self._watch_fall(sample, dt)
        if sample.crossed:
            self.crossings += 1
            self.driver.reset(self.skill)
        return sample

    def _move_target(self, dt: float) -> None:
        """Follow the keys: held ones move their axis, those let go spring back."""
        for axis in range(3):
            if self._held[axis] <= 0:
                continue
            self._held[axis] -= dt
            if self._held[axis] > 0:
                value = self.target[axis] + self._direction[axis] * _RAMP[axis] * dt
                self.target[axis] = np.clip(value, *self.limits[axis])
            elif axis != FORWARD:
                self.target[axis] = 0.0

    def _watch_fall(self, sample: Sample, dt: float) -> None:
        self._down = self._down + dt if sample.fallen else 0.0
        if self._down >= FALL_SECONDS:
            self.falls += 1
            self.notice = f"fell in {self.skills[self.skill]}: put back"
            self.reset()


def _drive(policy: OnboardPolicy, terrain: Terrain, tile: Tile) -> Driver:
    driver = Driver(policy, terrain)
    if not tile.is_flat:
        driver.show(tile.kind, tile.level, tile.variant)
    return driver
