"""What a policy file says about itself: everything a robot needs besides the network."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from kiras_rl.deploy.errors import PlainError
from kiras_rl.deploy.terms import Reading, find_rebuild

if TYPE_CHECKING:
    from kiras_rl.deploy.terms import Rebuild

from kiras_rl.deploy.profile import Profile

FORMAT = 1
METADATA_KEY = "kiras"  # the entry of the ONNX file's metadata that holds the JSON text


class PolicyError(PlainError, ValueError):
    """A policy file, or a reading given to a policy, that cannot be used; the message says why."""


@dataclass(frozen=True)
class ObservationTerm:
    """One block of a frame: `size` numbers, each multiplied by `scale`.

    `onboard` is what rebuilds it from a reading, see `kiras_rl.deploy.terms`; by its own name where
    it is None.
    """

    name: str
    size: int
    scale: float
    onboard: str | None = None

    def rebuild(self) -> Rebuild:
        """Return what rebuilds the term.

        Raises:
            PolicyError: There is nothing.
        """
        try:
            return find_rebuild(self.onboard or self.name)
        except LookupError as error:
            known = error.args[0]
        raise PolicyError(f"policy metadata: unknown observation term '{self.name}'; {known}")


@dataclass(frozen=True)
class Posture:
    """Keyframe of a skill: base height in m, pitch (nose down positive) and joint angles in rad."""

    base_height: float
    pitch: float
    joint_pos: tuple[float, ...]


@dataclass(frozen=True)
class CommandRange:
    """Velocities that the policy was trained to follow, (lowest, highest), m/s and rad/s."""

    lin_vel_x: tuple[float, float]
    lin_vel_y: tuple[float, float]
    ang_vel_z: tuple[float, float]


@dataclass(frozen=True)
class PolicyMetadata:
    """Robot, observation, action and skills of one policy.

    Joint quantities follow `joint_names`: angles in rad, gains in N m/rad and N m s/rad, torques
    in N m.
    A joint target is `default_joint_pos + action_scale * clip(action, -action_clip, action_clip)`,
    clipped to `joint_limits`, (lowest, highest) per joint in rad. They and `velocity_limit`, in
    rad/s, are None in a file that was written before files held them; infinite for a joint that
    has none.
    `onboard` is what kiras-robot needs, or None in a file of before, and of a robot that has none.
    `history_length` counts the past frames, without the current one; `control_rate` is in Hz.
    `provenance` is free: what made the file, for people to read.

    Raises:
        PolicyError: If the parts do not fit each other.
    """

    robot: str
    joint_names: tuple[str, ...]
    default_joint_pos: tuple[float, ...]
    kp: tuple[float, ...]
    kd: tuple[float, ...]
    torque_limit: tuple[float, ...]
    action_scale: tuple[float, ...]
    action_clip: float
    observation: tuple[ObservationTerm, ...]
    history_length: int
    skills: tuple[str, ...]
    keyframes: dict[str, Posture]
    control_rate: float
    command_range: CommandRange
    version: str
    provenance: dict[str, Any] = field(default_factory=dict)
    joint_limits: tuple[tuple[float, float], ...] | None = None
    velocity_limit: tuple[float, ...] | None = None
    onboard: Profile | None = None

    def __post_init__(self) -> None:
        """Check lengths, names and signs, so that nothing later has to."""
        self._check_joints()
        self._check_skills()
        self._check_observation()
        for name in ("action_clip", "history_length", "control_rate"):
            _require(getattr(self, name) > 0, f"{name} must be positive, not {getattr(self, name)}")

    @property
    def num_joints(self) -> int:
        """Number of joints, J."""
        return len(self.joint_names)

    @property
    def base_robot(self) -> str:
        """Name of the robot without that of its variant: solo8 of solo8:12A."""
        return self.robot.partition(":")[0]

    @property
    def frame_size(self) -> int:
        """Width of one frame, P."""
        return sum(term.size for term in self.observation)

    @property
    def history_size(self) -> int:
        """Width of the flattened history, H*P."""
        return self.history_length * self.frame_size

    def to_dict(self) -> dict[str, Any]:
        """Return plain dicts, tuples and numbers, with the format number."""
        values = asdict(self)
        for term in values["observation"]:
            if term["onboard"] is None:
                del term["onboard"]
        return {"format": FORMAT, **values}

    def to_json(self) -> str:
        """Return the JSON text that travels in the policy file."""
        values = self.to_dict()
        for name in _LIMITS:
            values[name] = _without_infinity(values[name])
        return json.dumps(values, default=str)  # provenance may hold anything

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> PolicyMetadata:
        """Build from plain data, which may be what JSON or a checkpoint gave back.

        Keys that this version does not know are left out.

        Raises:
            PolicyError: If the format is another one, or a value is missing or does not fit.
        """
        given = data.get("format")
        _require(
            given == FORMAT,
            f"format {given} was given, and this version of kiras-rl reads format {FORMAT}: "
            "export the policy again, or install the version that wrote it",
        )
        missing = [name for name in _READERS if name not in data and name not in _LATER]
        _require(not missing, f"missing: {', '.join(missing)}")
        known = {
            n: read for n, read in _READERS.items() if n not in _LATER or data.get(n) is not None
        }
        return cls(**{name: _read(name, reader, data[name]) for name, reader in known.items()})

    @classmethod
    def from_json(cls, text: str) -> PolicyMetadata:
        """Parse the JSON text of a policy file.

        Raises:
            PolicyError: If the text is not a description of a policy.
        """
        try:
            data = json.loads(text)
        except json.JSONDecodeError as error:
            raise PolicyError(f"policy metadata: not valid JSON ({error})") from None
        _require(isinstance(data, dict), "not a JSON object")
        return cls.from_dict(data)

    def _check_joints(self) -> None:
        for name in ("default_joint_pos", "kp", "kd", "torque_limit", "action_scale"):
            count = len(getattr(self, name))
            _require(
                count == self.num_joints,
                f"{name} holds {count} numbers for {self.num_joints} joints",
            )
        for name in _LIMITS:
            given = getattr(self, name)
            _require(
                given is None or len(given) == self.num_joints,
                f"{name} holds {0 if given is None else len(given)} entries for "
                f"{self.num_joints} joints",
            )
        for low, high in self.joint_limits or ():
            _require(low < high, f"joint_limits hold ({low}, {high}): the lower number comes first")
        _require(all(scale > 0 for scale in self.action_scale), "action_scale must be positive")

    def _check_skills(self) -> None:
        _require(len(self.skills) > 0, "no skills")
        without = [skill for skill in self.skills if skill not in self.keyframes]
        _require(not without, f"no keyframe for the skills {', '.join(without)}")
        for skill, posture in self.keyframes.items():
            count = len(posture.joint_pos)
            _require(
                count == self.num_joints,
                f"keyframe {skill} holds {count} angles for {self.num_joints} joints",
            )

    def _check_observation(self) -> None:
        example = Reading.example(self.num_joints, len(self.skills))
        _require(len(self.observation) > 0, "no observation terms")
        for term in self.observation:
            size = len(term.rebuild()(example))
            _require(
                term.size == size,
                f"observation term '{term.name}' has size {term.size}, expected {size}",
            )


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise PolicyError(f"policy metadata: {message}")


def _read(name: str, reader: Callable[[Any], Any], value: Any) -> Any:
    try:
        return reader(value)
    except PolicyError:
        raise
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        raise PolicyError(f"policy metadata: {name} cannot be read ({error!r})") from None


def _number(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{number} is not finite")
    return number


def _numbers(values: Sequence[Any]) -> tuple[float, ...]:
    return tuple(_number(value) for value in values)


def _names(values: Sequence[Any]) -> tuple[str, ...]:
    return tuple(str(value) for value in values)


def _terms(values: Sequence[Mapping[str, Any]]) -> tuple[ObservationTerm, ...]:
    return tuple(
        ObservationTerm(
            str(term["name"]), int(term["size"]), _number(term["scale"]), term.get("onboard")
        )
        for term in values
    )


def _postures(values: Mapping[str, Mapping[str, Any]]) -> dict[str, Posture]:
    return {
        str(skill): Posture(
            _number(value["base_height"]), _number(value["pitch"]), _numbers(value["joint_pos"])
        )
        for skill, value in values.items()
    }


def _limits(values: Sequence[Any]) -> tuple[tuple[float, float], ...]:
    return tuple((_limit(low, -math.inf), _limit(high, math.inf)) for low, high in values)


def _without_infinity(values: Any) -> Any:
    """Return nested numbers with None for those that are infinite: JSON has no infinity."""
    if isinstance(values, list | tuple):
        return [_without_infinity(value) for value in values]
    return None if values is not None and math.isinf(values) else values


def _largest(values: Sequence[Any]) -> tuple[float, ...]:
    return tuple(_limit(value, math.inf) for value in values)


def _limit(value: Any, none: float) -> float:
    """Read a number, or None for no limit; infinity, which JSON does not have, is none either."""
    return none if value is None or math.isinf(value) else _number(value)


def _interval(values: Sequence[Any]) -> tuple[float, float]:
    low, high = _numbers(values)
    return low, high


def _command_range(values: Mapping[str, Any]) -> CommandRange:
    axes = ("lin_vel_x", "lin_vel_y", "ang_vel_z")
    return CommandRange(**{axis: _interval(values[axis]) for axis in axes})


_LIMITS = ("joint_limits", "velocity_limit")
_LATER = (*_LIMITS, "onboard")
"""Entries that files of the first versions lack."""

_READERS: dict[str, Callable[[Any], Any]] = {
    "robot": str,
    "joint_names": _names,
    "default_joint_pos": _numbers,
    "kp": _numbers,
    "kd": _numbers,
    "torque_limit": _numbers,
    "joint_limits": _limits,
    "velocity_limit": _largest,
    "action_scale": _numbers,
    "action_clip": _number,
    "observation": _terms,
    "history_length": int,
    "skills": _names,
    "keyframes": _postures,
    "control_rate": _number,
    "command_range": _command_range,
    "version": str,
    "provenance": dict,
    "onboard": Profile.from_dict,
}
