"""How closely a policy keeps to the keyframes while it walks, and what its gait is like.

The paper's protocol: robots in each skill for 120 control steps; here on flat ground, after a
second that does not count.

Letters: N robots, T counted steps, S skills, J joints, F feet, D pose features.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import torch

from kiras_rl.evaluation.dtw import frame_distances
from kiras_rl.evaluation.flat import SETTLE, Policy, deal_skills, power, walk
from kiras_rl.evaluation.gait import clearance, lifts_per_second
from kiras_rl.interfaces import SkillEnv

STEPS = 120  # counted, after SETTLE seconds that are not [paper]
GRAVITY_WEIGHT = 3.0  # of the unit vector in the distance of two poses; a radian of a joint is 1
HEIGHT_WEIGHT = 10.0  # 1/m; both as in Phi of cfg/base.yaml, for every policy alike
GRAVITY = 9.81  # m/s^2


@dataclass(frozen=True)
class SkillImitation:
    """One skill: means over steps and robots until they fall; NaN where there is none to count.

    Attributes:
        dtw: Distance by dynamic time warping to the keyframe, STEPS frames, mean over robots.
        dtw_std: Its standard deviation over robots.
        dtw_frame: dtw / STEPS.
        cosine: Cosine of the angle between pose and keyframe.
        centred_cosine: The same after the mean keyframe of all skills is subtracted from both.
        height_error: Mean |height - keyframe|, m.
        pitch_error: Mean |pitch - keyframe|, rad.
        accuracy: Share of the steps in which the nearest keyframe is the skill's own.
        velocity: Mean v_x in the heading frame, m/s.
        clearance: Mean over swings of the largest height of the foot above the ground, m.
        frequency: Lifts a second of a foot, mean over feet.
        duty: Share of the time that a foot stands, mean over feet.
        torque: Mean |torque| of a joint, N m.
        peak_torque: Largest |torque| of a robot's joints, mean over robots, N m.
        power: Sum over the joints of |torque * velocity|, W; the torque is a physics step older.
        cost_of_transport: power / (weight * velocity), with the mass before randomization.
        falls: Share of robots that fell, in the first second or later.
    """

    dtw: float
    dtw_std: float
    dtw_frame: float
    cosine: float
    centred_cosine: float
    height_error: float
    pitch_error: float
    accuracy: float
    velocity: float
    clearance: float
    frequency: float
    duty: float
    torque: float
    peak_torque: float
    power: float
    cost_of_transport: float
    falls: float


@dataclass(frozen=True)
class Imitation:
    """Results of all skills.

    Attributes:
        skills: By name, in the order of the environment.
        confusion: Share of the steps of each skill (rows) that are nearest to each keyframe
            (columns), (S, S).
    """

    skills: dict[str, SkillImitation]
    confusion: torch.Tensor

    def as_dict(self) -> dict:
        """Return plain values for JSON; None where there was nothing to count."""
        skills = {
            name: {key: _plain(value) for key, value in asdict(result).items()}
            for name, result in self.skills.items()
        }
        confusion = [[_plain(share) for share in row] for row in self.confusion.tolist()]
        return {"skills": skills, "confusion": confusion}


@dataclass(frozen=True)
class Motion:
    """What N robots did in T steps; see Measurements for frames and units."""

    skill: torch.Tensor  # (N,)
    height: torch.Tensor  # (T, N)
    pitch: torch.Tensor  # (T, N)
    velocity: torch.Tensor  # (T, N)
    gravity_b: torch.Tensor  # (T, N, 3)
    joint_pos: torch.Tensor  # (T, N, J)
    peak_torque: torch.Tensor  # (T, N, J)
    joint_torque: torch.Tensor  # (T, N, J)
    power: torch.Tensor  # (T, N)
    stands: torch.Tensor  # (T, N, F)
    foot_height: torch.Tensor  # (T, N, F)
    alive: torch.Tensor  # (T, N): not fallen up to and including this step
    step_dt: float

    def poses(self) -> torch.Tensor:
        """Return the pose features of each step, (T, N, D); see `pose_features`."""
        return pose_features(self.gravity_b, self.joint_pos, self.height)


def evaluate_imitation(env: SkillEnv, policy: Policy, command: float) -> Imitation:
    """Walk every skill straight ahead on flat ground from its own keyframe.

    Args:
        env: Worlds are dealt to the skills in turn.
        policy: Observation -> mean actions.
        command: v_x, m/s.
    """
    return summarize(record_motion(env, policy, command), env)


@torch.no_grad()
def record_motion(env: SkillEnv, policy: Policy, command: float) -> Motion:
    """Walk every skill, and keep the STEPS that count; the ground has to be flat."""
    skill, commands = deal_skills(env, command)
    start = round(SETTLE / env.step_dt)
    steps = [
        (
            *(now.base_height, now.pitch, now.lin_vel_h[:, 0], now.gravity_b),
            *(now.joint_pos, now.peak_torque, now.joint_torque, power(now)),
            *(now.foot_stands, now.foot_height, alive),
        )
        for now, alive in walk(env, policy, (start + STEPS) * env.step_dt, skill, commands)
    ]
    signals = (torch.stack(x) for x in zip(*steps[start:], strict=True))
    return Motion(skill, *signals, step_dt=env.step_dt)


def pose_features(
    gravity_b: torch.Tensor, joint_pos: torch.Tensor, height: torch.Tensor
) -> torch.Tensor:
    """Return what is compared with a keyframe: weighted gravity, joints and height, (..., D).

    Args:
        gravity_b: Unit vector of gravity in the base frame, (..., 3).
        joint_pos: Absolute joint angles, (..., J), rad.
        height: Base height, (...,), m.
    """
    parts = (GRAVITY_WEIGHT * gravity_b, joint_pos, HEIGHT_WEIGHT * height[..., None])
    return torch.cat(parts, dim=-1)


def keyframe_poses(env: SkillEnv) -> torch.Tensor:
    """Return the pose features of each keyframe, (S, D)."""
    pitch = env.keyframe_pitch
    gravity_b = torch.stack([pitch.sin(), torch.zeros_like(pitch), -pitch.cos()], dim=-1)
    return pose_features(gravity_b, env.keyframe_joint_pos, env.keyframe_height)


def summarize(motion: Motion, env: SkillEnv) -> Imitation:
    """Reduce a motion to one result a skill; a robot counts until it falls."""
    per_robot = _posture(motion, env) | _gait(motion)
    keyframes = keyframe_poses(env)
    nearest = _shares_nearest(motion, keyframes)
    results, confusion = {}, []
    for index, name in enumerate(env.skills):
        mine = motion.skill == index
        counted = mine & motion.alive[0]  # who fell before has no step to count
        values = {key: value[counted].mean().item() for key, value in per_robot.items()}
        confusion.append(nearest[counted].mean(dim=0))
        results[name] = SkillImitation(
            **values,
            dtw=STEPS * values["dtw_frame"],
            dtw_std=STEPS * _spread(per_robot["dtw_frame"][counted]),
            accuracy=confusion[-1][index].item(),
            clearance=_clearance(motion, counted),
            cost_of_transport=_cost(values["power"], env.mass, values["velocity"]),
            falls=1.0 - motion.alive[-1, mine].float().mean().item(),
        )
    return Imitation(results, torch.stack(confusion).cpu())


def _posture(motion: Motion, env: SkillEnv) -> dict[str, torch.Tensor]:
    """Return how near each robot kept to its keyframe, (N,) each."""
    poses, keyframes = motion.poses(), keyframe_poses(env)
    centre, own = keyframes.mean(dim=0), keyframes[motion.skill]
    height = motion.height - env.keyframe_height[motion.skill]
    pitch = motion.pitch - env.keyframe_pitch[motion.skill]
    signals = {
        "dtw_frame": frame_distances(poses, own),
        "cosine": torch.cosine_similarity(poses, own, dim=-1),
        "centred_cosine": torch.cosine_similarity(poses - centre, own - centre, dim=-1),
        "height_error": height.abs(),
        "pitch_error": pitch.abs(),
    }
    return {key: _mean(signal, motion.alive) for key, signal in signals.items()}


def _gait(motion: Motion) -> dict[str, torch.Tensor]:
    """Return how each robot moved, (N,) each."""
    torque, alive = motion.joint_torque.abs(), motion.alive
    return {
        "velocity": _mean(motion.velocity, alive),
        "frequency": lifts_per_second(motion.stands, alive, motion.step_dt).mean(dim=-1),
        "duty": _mean(motion.stands.float().mean(dim=-1), alive),
        "torque": _mean(torque.mean(dim=-1), alive),
        "peak_torque": torch.where(alive, motion.peak_torque.amax(dim=-1), 0.0).amax(dim=0),
        "power": _mean(motion.power, alive),
    }


def _shares_nearest(motion: Motion, keyframes: torch.Tensor) -> torch.Tensor:
    """Return the share of each robot's steps that are nearest to each keyframe, (N, S)."""
    distances = frame_distances(motion.poses()[:, :, None], keyframes)  # (T, N, S)
    nearest = torch.nn.functional.one_hot(distances.argmin(dim=-1), len(keyframes)).float()
    return _mean(nearest, motion.alive[..., None])


def _clearance(motion: Motion, robots: torch.Tensor) -> float:
    """Return the mean of the largest foot heights of all whole swings of some robots (N,), m."""
    peaks, swings = clearance(
        motion.stands[:, robots], motion.foot_height[:, robots], motion.alive[:, robots]
    )
    return (peaks.sum() / swings.sum()).item()  # NaN without a swing


def _mean(signal: torch.Tensor, alive: torch.Tensor) -> torch.Tensor:
    """Average (T, N, ...) over the steps before a fall; NaN without such a step."""
    return torch.where(alive, signal, 0.0).sum(dim=0) / alive.sum(dim=0)


def _spread(values: torch.Tensor) -> float:
    """Return the standard deviation of (n,) around its own mean; 0 for one value."""
    return (values - values.mean()).square().mean().sqrt().item()


def _cost(power: float, mass: float, velocity: float) -> float:
    """Return the cost of transport; NaN for a robot that does not get ahead."""
    return power / (mass * GRAVITY * velocity) if velocity > 0 else math.nan


def _plain(value: float) -> float | None:
    return value if math.isfinite(value) else None
