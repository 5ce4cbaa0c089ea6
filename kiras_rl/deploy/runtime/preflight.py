"""kiras-robot check: what somebody reads before a leg moves.

Letters: J joints.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.deploy.profile import Profile
from kiras_rl.deploy.runtime.driver import keep_pace
from kiras_rl.deploy.runtime.messages import NANO
from kiras_rl.deploy.runtime.profiles import profile_of, source_of

STEPS = 500  # of the network
SECONDS = 2.0  # of each loop


def check(path: Path) -> tuple[list[str], list[str]]:
    """Describe a policy file and this machine.

    Returns:
        Lines to read, and what makes kiras-robot refuse it.

    Raises:
        PolicyError: If the file is no policy, or there is no profile of its robot.
    """
    policy = OnboardPolicy(path)
    profile = profile_of(policy.metadata)
    lines = [*_file(policy, path), *_joints(policy), *_first_targets(policy)]
    lines += [*_limits(profile), f"numbers      of {source_of(policy.metadata)}"]
    lines += _deadlines(policy, profile)
    return lines, refusals(policy, profile)


def refusals(policy: OnboardPolicy, profile: Profile) -> list[str]:
    """Return why a policy cannot be run on a robot; empty if it can."""
    meta, found = policy.metadata, []
    if max(meta.kp) > profile.max_kp:
        found.append(
            f"kp is {max(meta.kp):g} N m/rad, and {meta.base_robot}'s electronics carry "
            f"{profile.max_kp:g}: train with less (kp in robots/{meta.base_robot}/robot.yaml)"
        )
    for skill, posture in meta.keyframes.items():
        for j, (low, high) in enumerate(_ranges(policy)):
            name, pos = meta.joint_names[j], posture.joint_pos[j]
            if not low <= pos <= high:
                found.append(
                    f"{skill}: {name} stands at {pos:.2f} rad, outside {low:g} to {high:g}"
                )
    return found


def _ranges(policy: OnboardPolicy) -> tuple[tuple[float, float], ...]:
    meta = policy.metadata
    return meta.joint_limits or ((-np.inf, np.inf),) * meta.num_joints


def _file(policy: OnboardPolicy, path: Path) -> Iterator[str]:
    meta = policy.metadata
    made = ", ".join(
        f"{key} {meta.provenance[key]}"
        for key in ("iterations", "steps", "commit")
        if key in meta.provenance
    )
    ranges = meta.command_range
    yield f"policy       {path} ({path.stat().st_size / 1000:.0f} kB, by kiras-rl {meta.version})"
    yield f"made by      {made or 'not told'}"
    yield f"robot        {meta.robot}, {meta.num_joints} joints, policy at {meta.control_rate:g} Hz"
    yield f"skills       {', '.join(meta.skills)}; stands up and takes over in {meta.skills[0]}"
    yield (
        f"commands     v_x {_span(ranges.lin_vel_x)}, v_y {_span(ranges.lin_vel_y)} m/s, "
        f"yaw {_span(ranges.ang_vel_z)} rad/s"
    )


def _joints(policy: OnboardPolicy) -> Iterator[str]:
    meta = policy.metadata
    yield "joints       range rad, speed rad/s, torque N m, kp N m/rad, kd N m s/rad"
    for j, (low, high) in enumerate(_ranges(policy)):
        speed = meta.velocity_limit[j] if meta.velocity_limit else np.inf
        yield (
            f"  {meta.joint_names[j]:<15} {low:6.2f} to {high:5.2f}  {speed:5.1f}  "
            f"{meta.torque_limit[j]:5.2f}  {meta.kp[j]:5.1f}  {meta.kd[j]:5.2f}"
        )
    if meta.joint_limits is None:
        yield "  this file is of a version that had no joint ranges: targets are not clamped"


def _first_targets(policy: OnboardPolicy) -> Iterator[str]:
    """Tell how far the first targets are from the posture that the robot stands in."""
    meta = policy.metadata
    parts = []
    for skill in meta.skills:
        posture = meta.keyframes[skill]
        pose, half = np.array(posture.joint_pos), posture.pitch / 2
        policy.reset(pose)
        quat = (np.cos(half), 0.0, np.sin(half), 0.0)
        target = policy.step(pose, np.zeros(len(pose)), quat, np.zeros(3), np.zeros(3), skill)
        parts.append(f"{skill} {np.abs(target - pose).max():.2f}")
    yield f"first target {', '.join(parts)} rad from the posture at most"


def _limits(profile: Profile) -> Iterator[str]:
    hottest, least = profile.max_temperature, profile.min_battery
    warns, lowers, damps = profile.late_ticks
    yield (
        f"checks       range + {profile.range_margin:g} rad ({profile.folded_margin:g} lying), "
        f"tilt {profile.max_tilt:g} degrees, torque x {profile.torque_factor:g}, "
        f"power {profile.max_power:g} W, free fall {profile.free_fall:g} m/s^2"
    )
    yield (
        f"             motors {'not measured' if hottest is None else f'{hottest:g} degC'}, "
        f"battery {'not measured' if least is None else f'{100 * least:.0f} %'}, "
        f"late ticks {warns} warn, {lowers} lower, {damps} damp"
    )


def _deadlines(policy: OnboardPolicy, profile: Profile) -> Iterator[str]:
    meta = policy.metadata
    proprio = np.zeros((1, meta.frame_size), np.float32)
    history = np.zeros((1, meta.history_size), np.float32)
    times = []
    for _ in range(STEPS):
        begun = time.perf_counter()
        policy.infer(proprio, history)
        times.append(1000 * (time.perf_counter() - begun))
    p50, p99 = np.quantile(times, (0.5, 0.99))
    yield f"machine      {platform.machine()}, Python {platform.python_version()}"
    yield f"network      p50 {p50:.2f}, p99 {p99:.2f}, max {max(times):.2f} ms"
    for who, rate in (("runtime", meta.control_rate), ("driver", profile.rate)):
        end = time.monotonic_ns() + round(SECONDS * NANO)
        yield f"{who:<12} at {rate:g} Hz: {keep_pace(lambda now, end=end: now > end, rate).line()}"


def _span(values: tuple[float, float]) -> str:
    return f"{values[0]:g} to {values[1]:g}"
