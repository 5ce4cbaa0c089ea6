"""Scripts: what a robot is to do for how long, and everything that happened meanwhile."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from kiras_rl.deploy.policy import PolicyError, PolicyMetadata
from kiras_rl.tools.driving.driver import Driver, Sample
from kiras_rl.tools.driving.ground import FLAT


@dataclass(frozen=True)
class Segment:
    """Part of a script: a skill and a command for some seconds.

    `command` is v_x, v_y in m/s and yaw rate in rad/s.
    """

    duration: float
    skill: str
    command: tuple[float, float, float]


@dataclass(frozen=True)
class Trace:
    """Samples of a script, stacked over T steps, and what is needed to read them.

    The arrays are the fields of `Sample` with a leading T.
    """

    robot: str
    terrain: str
    """Type, level and variant, as `--terrain` takes them."""
    skills: tuple[str, ...]
    feet: tuple[str, ...]
    rate: float
    """Samples a second."""
    time: np.ndarray
    base_height: np.ndarray
    pitch: np.ndarray
    roll: np.ndarray
    lin_vel: np.ndarray
    yaw_rate: np.ndarray
    foot_contact: np.ndarray
    joint_torque: np.ndarray
    joint_pos: np.ndarray
    skill: np.ndarray
    command: np.ndarray
    fallen: np.ndarray
    crossed: np.ndarray
    qpos: np.ndarray
    segment: np.ndarray
    """Index of the script's segment, (T,)."""

    @property
    def is_flat(self) -> bool:
        """Whether it was driven on the endless floor."""
        return self.terrain == str(FLAT)

    @property
    def title(self) -> str:
        """Robot, ground and duration, for a heading."""
        ground = "" if self.is_flat else f" on {self.terrain}"
        return f"{self.robot}{ground}, {self.time[-1]:.3g} s"

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all arrays and names, as an .npz file holds them."""
        return {item.name: getattr(self, item.name) for item in fields(self)}


def record(driver: Driver, script: Sequence[Segment]) -> Trace:
    """Run a script and keep every sample.

    A robot that has fallen, or crossed its tile, starts again in its skill's posture.
    """
    samples, segments = [], []
    driver.reset(script[0].skill)
    for number, segment in enumerate(script):
        driver.set_task(segment.skill, segment.command)
        for _ in range(max(1, round(segment.duration * driver.metadata.control_rate))):
            sample = driver.step()
            samples.append(sample)
            segments.append(number)
            if sample.fallen or sample.crossed:
                driver.reset(segment.skill)
    stacked = {
        item.name: np.array([getattr(sample, item.name) for sample in samples])
        for item in fields(Sample)
    }
    meta = driver.metadata
    return Trace(
        robot=meta.robot,
        terrain=str(driver.tile),
        skills=meta.skills,
        feet=driver.robot.foot_geoms,
        rate=meta.control_rate,
        segment=np.array(segments),
        **stacked,
    )


def default_script(
    metadata: PolicyMetadata, command: tuple[float, float, float] = (0.3, 0.0, 0.0)
) -> list[Segment]:
    """Stand for a second, then every skill of the policy for four, one after the other."""
    stand = Segment(1.0, metadata.skills[0], (0.0, 0.0, 0.0))
    return [stand, *(Segment(4.0, skill, command) for skill in metadata.skills)]


def parse_script(text: str, metadata: PolicyMetadata) -> list[Segment]:
    """Read a script such as `walk:4:0.3,crawl:4:0.3:0:0.2`.

    Each part is skill:seconds:v_x, and may go on with :v_y and :yaw_rate.

    Raises:
        PolicyError: If a part cannot be read or names a skill that the policy does not have.
    """
    return [_parse_segment(part.strip(), metadata) for part in text.split(",")]


def parse_command(text: str) -> tuple[float, float, float]:
    """Read `v_x[,v_y[,yaw_rate]]`, m/s and rad/s; what is left out is zero.

    Raises:
        PolicyError: If these are not one to three finite numbers.
    """
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not 1 <= len(numbers) <= 3 or not np.isfinite(numbers).all():
        raise PolicyError(f"a command is v_x[,v_y[,yaw_rate]], e.g. 0.3 or 0.3,0,0.5, not '{text}'")
    v_x, v_y, yaw_rate = [*numbers, 0.0, 0.0][:3]
    return v_x, v_y, yaw_rate


def _parse_segment(part: str, metadata: PolicyMetadata) -> Segment:
    skill, _, rest = part.partition(":")
    duration, _, command = rest.partition(":")
    try:
        seconds = float(duration)
    except ValueError:
        seconds = -1.0
    if not 0 < seconds < np.inf or not command:
        raise PolicyError(
            f"a script's part is skill:seconds:v_x[:v_y[:yaw_rate]], e.g. "
            f"{metadata.skills[0]}:4:0.3, not '{part}'"
        )
    if skill not in metadata.skills:
        raise PolicyError(
            f"unknown skill '{skill}' in the script; this policy has: {', '.join(metadata.skills)}"
        )
    return Segment(seconds, skill, parse_command(command.replace(":", ",")))
