"""Recording what a policy does in the environment, as a dataset."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from tensordict import TensorDict

from kiras_rl.dataset import Dataset, DatasetError, Feature
from kiras_rl.envs.quadruped import QuadrupedEnv
from kiras_rl.evaluation.flat import Policy
from kiras_rl.interfaces import COMMAND, EXTRA_IMITATION, Measurements
from kiras_rl.robots.robot import Robot

XYZ = ("x", "y", "z")

Range = tuple[float, float]


@dataclass(frozen=True)
class Plan:
    """What to record, one episode a world.

    Attributes:
        skills: Names of the skills.
        episodes: How many of each.
        duration: Of an episode, unless the robot falls or leaves its tile, s.
        command: Ranges from which v_x, v_y (m/s) and yaw rate (rad/s) of an episode are drawn.
        seed: Of everything random.
        terrain: Type and level of the ground, or None where it is flat. There the heading of the
            start is held, in place of the yaw rate.
    """

    skills: tuple[str, ...]
    episodes: int
    duration: float
    command: tuple[Range, Range, Range]
    seed: int
    terrain: tuple[str, int] | None = None

    @property
    def num_envs(self) -> int:
        """Worlds that it takes."""
        return len(self.skills) * self.episodes


@torch.no_grad()
def collect(env: QuadrupedEnv, policy: Policy, plan: Plan, provenance: dict) -> Dataset:
    """Run a policy and record its episodes, skill by skill.

    The first control step of an episode is not recorded: before it no sensor has read anything. A
    robot that falls in it leaves no episode.

    Args:
        env: With `plan.num_envs` worlds, none of which times out within `plan.duration`.
        policy: Observation -> mean actions.
        plan: What to record.
        provenance: What the dataset will say about its making.

    Raises:
        DatasetError: If every robot fell at once.
    """
    skill = torch.tensor([env.skills.index(name) for name in plan.skills], device=env.device)
    skill = skill.repeat_interleave(plan.episodes)
    obs = _begin(env, plan, skill)
    obs, _, done, extras = env.step(policy(obs))
    alive = ~done
    steps, labels = [], []
    for _ in range(max(1, round(plan.duration / env.step_dt))):
        state = _state_values(env.measure(), extras[EXTRA_IMITATION], obs[COMMAND])
        actions = policy(obs)
        obs, _, done, extras = env.step(actions)
        steps.append({name: array.cpu().numpy() for name, array in state.items()})
        steps[-1] |= _action_values(env, actions)
        labels.append([x.cpu().numpy() for x in (alive, done, env.measure().fallen)])
        alive = alive & ~done
        if not alive.any():
            break
    if not labels[0][0].any():
        raise DatasetError("no episodes: every robot fell in its first control step")
    return _assemble(env, plan, steps, labels, provenance)


def describe_features(env: QuadrupedEnv) -> dict[str, Feature]:
    """Return names and units of everything that is recorded of a frame."""
    robot = env.robot_cfg
    joints, feet = robot.joint_names, robot.foot_geoms

    def feature(names: tuple[str, ...], unit: str) -> Feature:
        return Feature(names, (unit,) * len(names))

    return {
        "base_height": feature(("height",), "m"),
        "base_pos_w": feature(XYZ, "m"),
        "base_quat_w": feature(("w", *XYZ), "1"),
        "projected_gravity": feature(XYZ, "1"),
        "base_lin_vel_h": feature(XYZ, "m/s"),
        "base_ang_vel_b": feature(XYZ, "rad/s"),
        "joint_pos": feature(joints, "rad"),
        "joint_vel": feature(joints, "rad/s"),
        "joint_torque": feature(joints, "N m"),
        "foot_contact": feature(feet, "1"),
        "imitation": _describe_imitation(env, robot),
        "command": Feature(("v_x", "v_y", "yaw_rate"), ("m/s", "m/s", "rad/s")),
        "action": feature(joints, "1"),
        "joint_target": feature(joints, "rad"),
    }


def _begin(env: QuadrupedEnv, plan: Plan, skill: torch.Tensor) -> TensorDict:
    """Reset every world into its episode; return the first observation."""
    low, high = np.array(plan.command).T
    drawn = np.random.default_rng(plan.seed).uniform(low, high, (plan.num_envs, 3))
    command = torch.tensor(drawn, dtype=torch.float32, device=env.device)
    env.seed(plan.seed)
    if plan.terrain is not None:
        kind, level = plan.terrain
        index = torch.full_like(skill, env.terrains.index(kind))
        env.place(index, torch.full_like(skill, level))
    return env.reset(skill, command, hold_heading=plan.terrain is not None)


def _state_values(
    now: Measurements, features: torch.Tensor, command: torch.Tensor
) -> dict[str, torch.Tensor]:
    return {
        "base_height": now.base_height[:, None],
        "base_pos_w": now.base_pos_w,
        "base_quat_w": now.base_quat_w,
        "projected_gravity": now.gravity_b,
        "base_lin_vel_h": now.lin_vel_h,
        "base_ang_vel_b": now.ang_vel_b,
        "joint_pos": now.joint_pos,
        "joint_vel": now.joint_vel,
        "joint_torque": now.joint_torque,
        "foot_contact": now.foot_contact,
        "imitation": features,
        "command": command,
    }


def _action_values(env: QuadrupedEnv, actions: torch.Tensor) -> dict[str, np.ndarray]:
    """Return actions as the environment clips them, and the joint targets they mean."""
    robot, clip = env.robot_cfg, env.cfg.action_clip
    clipped = actions.cpu().numpy().clip(-clip, clip)
    targets = robot.default_joint_pos + robot.action_scale * clipped
    return {"action": clipped, "joint_target": targets.astype(np.float32)}


def _assemble(
    env: QuadrupedEnv, plan: Plan, steps: list[dict], labels: list[list], provenance: dict
) -> Dataset:
    """Turn steps of all worlds into episodes one after the other."""
    alive, done, fallen = (np.stack(column, axis=1) for column in zip(*labels, strict=True))
    done[:, -1] = True
    worlds = np.flatnonzero(alive[:, 0])
    number = np.zeros(len(alive), np.int64)
    number[worlds] = np.arange(len(worlds))

    def frames(per_world: np.ndarray) -> np.ndarray:
        return np.broadcast_to(per_world[:, None], alive.shape)[alive]

    features = describe_features(env)
    return Dataset(
        robot=env.robot_cfg.name,
        # The sum of the physics steps is not exact in binary
        rate=round(1.0 / env.step_dt, 6),
        skills=plan.skills,
        features=features,
        values={name: np.stack([s[name] for s in steps], axis=1)[alive] for name in features},
        episode=frames(number),
        skill=frames(np.arange(len(plan.skills)).repeat(plan.episodes)),
        done=done[alive],
        fallen=fallen[alive],
        provenance=provenance,
    )


def _describe_imitation(env: QuadrupedEnv, robot: Robot) -> Feature:
    named = {
        "skill": robot.skills,
        "foot_height": robot.foot_geoms,
        "roll_pitch": ("roll", "pitch"),
        **dict.fromkeys(("projected_gravity", "base_lin_vel", "base_ang_vel"), XYZ),
        **dict.fromkeys(("joint_pos", "joint_vel", "last_action"), robot.joint_names),
    }
    names, units = [], []
    for (term, size, scale), unit in zip(env.imitation_terms, env.imitation_units, strict=True):
        parts = named.get(term, range(size)) if size > 1 else ()
        names += [f"{term}.{part}" for part in parts] or [term]
        unit = unit or "1"
        units += size * [unit if scale == 1.0 else f"{unit} / {scale:g}"]
    return Feature(tuple(names), tuple(units))
