"""A trained policy on a robot: readings in, joint targets out; numpy and onnxruntime only."""

from __future__ import annotations

import difflib
import operator
import os
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from kiras_rl.deploy.metadata import METADATA_KEY, PolicyError, PolicyMetadata
from kiras_rl.deploy.terms import Reading
from kiras_rl.deploy.terms import gravity as projected_gravity

if TYPE_CHECKING:
    import onnxruntime

__all__ = ["OnboardPolicy", "PolicyError", "PolicyMetadata", "projected_gravity"]

LARGEST_READING = 1000.0
"""rad, rad/s, m/s: beyond what joints, gyroscopes and commands can be; a driver's fault."""


class OnboardPolicy:
    """Runs one policy file in a control loop.

    Call `reset` when the robot stands in its start posture, then `step` at `metadata.control_rate`.
    The observation is rebuilt as in training: terms in the order of the file, each times its scale;
    the history holds the past frames, oldest first, and starts as copies of the first frame.

    Attributes:
        metadata: Robot, joints, gains, skills and command ranges of the policy.
        action: The last action, clipped, (J,).
        velocity: The policy's estimate of the base velocity in the base frame, (3,), m/s; zero
            if it has no estimator.
        frame: The last frame given to the network, (P,).
        history: The past frames that went with it, oldest first, (H, P).
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Load a policy file.

        Raises:
            PolicyError: If the file is missing, or not a policy that this version can run.
        """
        self._session = _open_session(Path(path))
        self.metadata = _read_metadata(self._session, Path(path))
        _check_widths(self._session, self.metadata, Path(path))
        meta = self.metadata
        self._default = np.array(meta.default_joint_pos)
        self._scale = np.array(meta.action_scale)
        limits = meta.joint_limits or [(-np.inf, np.inf)] * meta.num_joints
        self._low, self._high = np.array(limits).T
        self._terms = [(term.rebuild(), term.scale) for term in meta.observation]
        self._one_hot = np.eye(len(meta.skills))
        self._started = False
        self._steps = 0
        self.action = np.zeros(meta.num_joints)
        self.velocity = np.zeros(3)
        self.frame = np.zeros(meta.frame_size, np.float32)
        self.history = np.zeros((meta.history_length, meta.frame_size), np.float32)

    def reset(self, joint_pos: ArrayLike) -> None:
        """Forget the past; the next frame starts a new history.

        Args:
            joint_pos: Joint targets that the robot holds now, or where it stands, (J,), rad.
        """
        joint_pos = self._vector("joint_pos", joint_pos, self.metadata.num_joints)
        self.action = (joint_pos - self._default) / self._scale  # the action that holds this pose
        self.velocity = np.zeros(3)
        self._started = False
        self._steps = 0

    def step(
        self,
        joint_pos: ArrayLike,
        joint_vel: ArrayLike,
        imu_quat: ArrayLike,
        base_ang_vel: ArrayLike,
        command: ArrayLike,
        skill: str | int,
    ) -> np.ndarray:
        """Return the joint targets for the next control period.

        Args:
            joint_pos: Joint angles in the order of `metadata.joint_names`, (J,), rad.
            joint_vel: Joint velocities, (J,), rad/s.
            imu_quat: Orientation of the base in the world, (4,), w x y z; only its tilt is used.
            base_ang_vel: Angular velocity in the base frame, (3,), rad/s.
            command: Forward and sideward velocity in m/s and yaw rate in rad/s, (3,).
            skill: Name of a skill, or its index in `metadata.skills`.

        Returns:
            Joint targets within `metadata.joint_limits`, (J,), rad.

        Raises:
            PolicyError: If a reading has another length, is not finite or beyond LARGEST_READING,
                or the skill is unknown. The policy is then as it was before.
        """
        joints = self.metadata.num_joints
        reading = Reading(
            joint_pos=self._vector("joint_pos", joint_pos, joints) - self._default,
            joint_vel=self._vector("joint_vel", joint_vel, joints),
            imu_quat=_unit(self._vector("imu_quat", imu_quat, 4)),
            base_ang_vel=self._vector("base_ang_vel", base_ang_vel, 3),
            command=self._vector("command", command, 3),
            skill=self._one_hot[self.skill_index(skill)],
            last_action=self.action,
            time=self._steps / self.metadata.control_rate,
        )
        self._remember(self._observe(reading))
        self._steps += 1
        return self._act()

    def skill_index(self, skill: str | int) -> int:
        """Return the index of a skill that is given by name or index.

        Raises:
            PolicyError: If the policy has no such skill.
        """
        skills = self.metadata.skills
        if not isinstance(skill, str):
            with suppress(TypeError):  # what is no whole number
                if 0 <= operator.index(skill) < len(skills):
                    return operator.index(skill)
        elif skill in skills:
            return skills.index(skill)
        close = difflib.get_close_matches(str(skill), skills, n=1)
        hint = f" (did you mean '{close[0]}'?)" if close else ""
        raise PolicyError(f"unknown skill '{skill}'{hint}; this policy has: {', '.join(skills)}")

    def infer(self, proprio: np.ndarray, history: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Run the network alone, on frames that somebody else has built.

        Args:
            proprio: Current frames, (N, P) float32.
            history: Past frames, oldest first, (N, H * P) float32.

        Returns:
            Raw actions (N, J) and base velocities (N, 3), m/s.

        Raises:
            PolicyError: If the network returns numbers that are not finite.
        """
        inputs = {"proprio": proprio, "history": history}
        outputs = self._session.run(["actions", "velocity"], inputs)
        actions, velocity = map(np.asarray, outputs)
        if not np.isfinite(actions).all():
            raise PolicyError("the network returned numbers that are not finite: damaged weights?")
        return actions, velocity

    def _observe(self, reading: Reading) -> np.ndarray:
        blocks = [scale * term(reading) for term, scale in self._terms]
        return np.concatenate(blocks).astype(np.float32)

    def _remember(self, frame: np.ndarray) -> None:
        """Move the frame of the step before into the history and keep the new one."""
        if self._started:
            self.history = np.concatenate([self.history[1:], self.frame[None]])
        else:
            self.history = np.tile(frame, (len(self.history), 1))
            self._started = True
        self.frame = frame

    def _act(self) -> np.ndarray:
        actions, velocity = self.infer(self.frame[None], self.history.reshape(1, -1))
        clip = self.metadata.action_clip
        self.action = np.clip(actions[0].astype(np.float64), -clip, clip)
        self.velocity = velocity[0].astype(np.float64)
        return np.clip(self._default + self._scale * self.action, self._low, self._high)

    def _vector(self, name: str, values: ArrayLike, size: int) -> np.ndarray:
        try:
            vector = np.asarray(values, np.float64)
        except (TypeError, ValueError):
            raise PolicyError(f"{name} is no list of numbers: {values!r}") from None
        if vector.shape != (size,):
            raise PolicyError(
                f"{name} has shape {vector.shape}, expected ({size},) for {self.metadata.robot}"
            )
        if not np.isfinite(vector).all():
            raise PolicyError(f"{name} is not finite: {vector}")
        if np.abs(vector).max() > LARGEST_READING:
            raise PolicyError(
                f"{name} is beyond {LARGEST_READING:g}, which no sensor means: {vector}"
            )
        return vector


def _unit(quat: np.ndarray) -> np.ndarray:
    norm = np.linalg.norm(quat)
    if not 0.5 <= norm <= 2.0:  # a sensor that is not ready sends zeros; rounding is far from this
        raise PolicyError(f"imu_quat is not a rotation: {quat}")
    return quat / norm


def _open_session(path: Path) -> onnxruntime.InferenceSession:
    import onnxruntime

    if not path.is_file():
        raise PolicyError(f"no policy file at {path}")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # a network this small is slower on more threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(
            path.read_bytes(), options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # its exceptions share no base class of their own
        reason = str(error).splitlines()[0]
        raise PolicyError(f"{path} is not an ONNX file that can be run ({reason})") from None


def _read_metadata(session: onnxruntime.InferenceSession, path: Path) -> PolicyMetadata:
    entries = session.get_modelmeta().custom_metadata_map
    if METADATA_KEY not in entries:
        raise PolicyError(
            f"{path} is an ONNX file, but not a kiras policy: it lacks the metadata entry "
            f"'{METADATA_KEY}'; write it with kiras-export"
        )
    try:
        return PolicyMetadata.from_json(entries[METADATA_KEY])
    except PolicyError as error:
        raise PolicyError(f"{path}: {error}") from None


def _check_widths(
    session: onnxruntime.InferenceSession, metadata: PolicyMetadata, path: Path
) -> None:
    ports = (*session.get_inputs(), *session.get_outputs())
    given = {port.name: port.shape[-1] for port in ports}
    expected = {
        "proprio": metadata.frame_size,
        "history": metadata.history_size,
        "actions": metadata.num_joints,
        "velocity": 3,
    }
    if given != expected:
        raise PolicyError(
            f"{path}: the network has the widths {given}, its metadata ask for {expected}"
        )
