"""A black box of kiras-robot in place of a simulation: the robot is posed as it was measured."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from kiras_rl.dataset import Dataset, DatasetError, load_dataset
from kiras_rl.deploy.policy import OnboardPolicy, PolicyError
from kiras_rl.deploy.runtime.messages import Mode, State
from kiras_rl.tools.driving.driver import Driver, Sample
from kiras_rl.tools.shared import policy_files

_NEEDED = (
    *("time", "state", "mode", "base_quat_w", "base_ang_vel_b"),
    *("joint_pos", "joint_vel", "joint_torque", "command"),
)


def load_log(path: Path) -> Dataset:
    """Read a black box: the folder that kiras-robot wrote, or its dataset.json.

    Raises:
        PolicyError: If it is none; the text says why.
    """
    try:
        log = load_dataset(path.parent if path.name == "dataset.json" else path)
    except DatasetError as error:
        raise PolicyError(f"--log {path}: {error}") from None
    missing = [name for name in _NEEDED if name not in log.features]
    if missing:
        raise PolicyError(
            f"--log {path} is no black box of kiras-robot: it lacks {', '.join(missing)}"
        )
    return log


def policy_of(log: Dataset, source: Path | None) -> OnboardPolicy:
    """Return the policy whose keyframes a log is compared with.

    Args:
        log: Of `load_log`.
        source: Policy, run or checkpoint; None for the one that is shipped with the robot.

    Raises:
        PolicyError: If there is none, or it is of another robot or of other skills.
    """
    policy = policy_files.load_policy(source, None if source else log.robot.partition(":")[0])
    meta = policy.metadata
    if (meta.robot, meta.skills) != (log.robot, log.skills):
        raise PolicyError(
            f"the log is of {log.robot} with the skills {', '.join(log.skills)}, the policy of "
            f"{meta.robot} with {', '.join(meta.skills)}: name the one that ran, "
            "kiras-play POLICY --log FOLDER"
        )
    return policy


class Replay(Driver):
    """A driver whose robot does what a log says; tasks and pushes change nothing.

    A robot does not know where it is: it stays in its place, with its lowest foot on the ground,
    and its velocity is not known.

    Attributes:
        log: What is shown.
        is_over: Whether the last step has shown the last measurement.
    """

    def __init__(self, policy: OnboardPolicy, log: Dataset) -> None:
        """Show the first measurement.

        Args:
            policy: With the keyframes of the log's skills.
            log: Of `load_log`.
        """
        self.log = log
        self._times = log["time"][:, 0] - log["time"][0, 0]
        self._frame, self._shown = 0, 0.0
        super().__init__(policy)

    @property
    def time(self) -> float:
        """Seconds since the first measurement."""
        return self._shown

    @property
    def is_over(self) -> bool:
        """Whether the last measurement is shown."""
        return self._frame == len(self.log) - 1

    @property
    def situation(self) -> str:
        """Time, state of the runtime and mode of the motors, in words."""
        state, mode = (int(self.log[name][self._frame, 0]) for name in ("state", "mode"))
        names = State(state).name.lower(), Mode(mode).name.lower()
        return f"{self._shown:.1f} of {self._times[-1]:.1f} s: {names[0]}, motors {names[1]}"

    def set_command(self, command: ArrayLike) -> None:
        """Leave the command as the log has it."""

    def push(self, velocity: ArrayLike) -> None:
        """Leave the robot as the log has it."""

    def reset(self, skill: str | int) -> None:
        """Go back to the first measurement, whatever the skill."""
        mujoco.mj_resetData(self.model, self.data)
        self._show(0.0)

    def step(self, after_substep: Callable[[], None] | None = None) -> Sample:
        """Show the measurements of a control period, and return the last one.

        Args:
            after_substep: As in `Driver.step`.
        """
        begun, period = self._shown, 1.0 / self.metadata.control_rate
        for substep in range(self.substeps):
            self._show(begun + (substep + 1) / self.substeps * period)
            if after_substep is not None:
                after_substep()
        sample = self._sample(self.log["joint_torque"][self._frame].astype(np.float64))
        unknown = np.full(3, np.nan)
        return Sample(**{**vars(sample), "lin_vel": unknown, "fallen": False})

    def _show(self, time: float) -> None:
        """Pose the robot as it was last measured before a time from the start, s."""
        self._shown = min(time, float(self._times[-1]))
        frame = int(np.searchsorted(self._times, self._shown + 1e-9, "right")) - 1
        self._frame = frame
        self._skill = self._previous = int(self.log.skill[frame])
        self._command = self.log["command"][frame].astype(np.float64)
        data = self.data
        data.time = self._shown
        data.qpos[3:7], data.qpos[7:] = self.log["base_quat_w"][frame], self.log["joint_pos"][frame]
        data.qvel[3:6] = self.log["base_ang_vel_b"][frame]
        data.qvel[6:] = self.log["joint_vel"][frame]
        data.qpos[2] = 0.0
        mujoco.mj_kinematics(self.model, data)
        lowest = data.geom_xpos[self._feet, 2].min() - self.robot.foot_radius
        data.qpos[2] = -lowest
        mujoco.mj_forward(self.model, data)
