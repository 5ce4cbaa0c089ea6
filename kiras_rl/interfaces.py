"""The contract between learning and simulation: every name that crosses it, with its shape.

Letters: N worlds, P proprioceptive numbers, H frames of history, C critic numbers, D imitation
features, S skills, J joints, F feet.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

PROPRIO = "proprio"
"""What the robot measures at this step, with noise, (N, P)."""

HISTORY = "history"
"""The H frames of `proprio` before this one, oldest first, (N, H * P)."""

CRITIC = "critic"
"""Noise-free observation with privileged terms, (N, C)."""

IMITATION = "imitation"
"""Phi, the features compared with keyframes, noise-free, (N, D)."""

VELOCITY = "velocity"
"""Base linear velocity in the base frame, the estimator's target, (N, 3), m/s."""

SKILL = "skill"
"""One-hot code of the commanded skill, (N, S)."""

COMMAND = "command"
"""Commanded v_x, v_y in the heading frame and yaw rate, (N, 3), m/s and rad/s."""

CONTEXT = "context"
"""Output of the context estimator; written by the learner, never by the environment."""

FLAT_ACTION = "flat_action"
"""Action of the frozen flat policy, (N, J); written by the learner in finetuning."""

IS_FLAT = "is_flat"
"""Worlds whose ground is flat, (N, 1) bool; moved here from extras by the learner."""

NEXT_PROPRIO = "next_proprio"
"""Noise-free `proprio` after the step and before a reset, (N, P); extras, then storage."""

EXTRA_TIME_OUTS = "time_outs"
"""Episodes that were cut and might have gone on: by the clock, at the edge of a tile, for want of
memory, (N,) bool."""

EXTRA_IMITATION = "imitation"
"""Phi after the step and before a reset, (N, D)."""

EXTRA_VALID = "imitation_valid"
"""Whether Phi before and after the step belong to one undisturbed motion, (N,) bool."""

EXTRA_FLAT = "is_flat"
"""Worlds whose ground is flat, (N,) bool."""


EXTRA_CONSTRAINTS = "constraints"
"""How far each of `SkillEnv.constraints` is violated, (N, C), at least 0; 0 where physics broke.
Missing where none is configured."""

FALLS, TIME_OUTS = "Episode/falls", "Episode/time_outs"
"""Tags of the log, under which episodes that end are counted."""

ENDED_BY = "Episode/ended_by_"
"""Begin of the tags under which falls are counted by their reason; the runner logs them as shares
of all episodes that ended."""

EXTRA_PHYSICS_TIME = "physics_time"
"""How long the physics backend kept the host, s, a number."""


@dataclass(frozen=True)
class Measurements:
    """What an evaluation reads after a step, before automatic resets; shapes (N,) if not given.

    Attributes:
        base_pos_w: Base origin in the world, (N, 3), m.
        base_quat_w: Base to world, (N, 4).
        base_height: Base origin above the ground under the base, m.
        pitch: Nose down positive, rad.
        roll: rad.
        lin_vel_h: Base velocity in the heading frame, (N, 3), m/s.
        ang_vel_b: Base angular velocity in the base frame, (N, 3), rad/s.
        yaw_rate: rad/s about the vertical.
        gravity_b: Unit vector of gravity in the base frame, (N, 3).
        joint_pos: (N, J), rad.
        joint_vel: (N, J), rad/s.
        joint_torque: (N, J), N m, a physics step before the rest.
        peak_torque: Largest of the physics steps, (N, J), N m.
        beyond: Worlds with a joint beyond its limits, bool.
        saturated: Share of the physics steps in which a motor gave all that it may.
        foot_contact: Feet on the ground, (N, F) bool.
        foot_stands: Feet on the ground in any of the physics steps, (N, F) bool.
        foot_height: Of their lowest points above the ground, (N, F), m.
        limb_contact: Worlds where a thigh or shank touched the ground, bool.
        foot_load: Mean force on all feet, N.
        limb_load: Mean force on trunk, thighs and shanks, N.
        distance: How far the base is from the middle of its tile, the larger of |x| and |y|, m.
        fallen: Worlds that terminate by failure at this step, bool.
    """

    base_pos_w: torch.Tensor
    base_quat_w: torch.Tensor
    base_height: torch.Tensor
    pitch: torch.Tensor
    roll: torch.Tensor
    lin_vel_h: torch.Tensor
    ang_vel_b: torch.Tensor
    yaw_rate: torch.Tensor
    gravity_b: torch.Tensor
    joint_pos: torch.Tensor
    joint_vel: torch.Tensor
    joint_torque: torch.Tensor
    peak_torque: torch.Tensor
    beyond: torch.Tensor
    saturated: torch.Tensor
    foot_contact: torch.Tensor
    foot_stands: torch.Tensor
    foot_height: torch.Tensor
    limb_contact: torch.Tensor
    foot_load: torch.Tensor
    limb_load: torch.Tensor
    distance: torch.Tensor
    fallen: torch.Tensor


class SkillEnv(VecEnv):
    """A vectorised environment of one robot with S skills.

    `get_observations` and `step` return the groups above in a new TensorDict each time, never
    aliased to a buffer that the next step overwrites.
    """

    device: torch.device
    """Where the tensors are."""

    max_episode_length: int
    """Control steps after which an episode is cut."""

    skills: tuple[str, ...]
    """Names of the skills, in the order of their one-hot code."""

    step_dt: float
    """Duration of a control step, s."""

    keyframe_features: torch.Tensor
    """Phi of each skill's keyframe, (S, D)."""

    imitation_terms: tuple[tuple[str, int, float], ...]
    """Name, size and scale of each term of Phi, in their order."""

    imitation_units: tuple[str, ...] = ()
    """Unit of each of them before its scale; empty for none."""

    feature_noise: torch.Tensor
    """Standard deviation of one unit of discriminator input noise in each feature, (D,)."""

    keyframe_height: torch.Tensor
    """Base height of each keyframe, (S,), m."""

    keyframe_pitch: torch.Tensor
    """Pitch of each keyframe, (S,), rad."""

    keyframe_joint_pos: torch.Tensor
    """Joint angles of each keyframe, (S, J), rad."""

    keyframe_clearance: torch.Tensor
    """Height that a foot should clear in a step of each skill, (S,), m."""

    joint_limits: torch.Tensor
    """Least and largest angle of each joint, (2, J), rad; infinite for none."""

    velocity_limit: torch.Tensor
    """Largest velocity of each joint, (J,), rad/s; infinite for none."""

    torque_limit: torch.Tensor
    """Largest torque of each joint before randomization, (J,), N m."""

    mass: float
    """Mass of the robot before randomization, kg."""

    constraints: tuple[str, ...] = ()
    """Names of what is measured for the parts of a learner, see EXTRA_CONSTRAINTS."""

    terrains: tuple[str, ...] = ()
    """Names of the terrain types; none where all ground is flat."""

    terrain_levels: int = 0
    """Difficulty levels of each type."""

    @abstractmethod
    def seed(self, seed: int) -> None:
        """Restart the environment's random numbers."""

    @abstractmethod
    def reset(
        self,
        skill: torch.Tensor | None = None,
        command: torch.Tensor | None = None,
        hold_heading: bool = False,
    ) -> TensorDict:
        """Reset every world.

        Args:
            skill: Skill index to start and stay in, (N,), or None to draw it.
            command: Command, (N, 3), or None to draw it.
            hold_heading: Command the yaw rate that keeps the heading of the start, in place of
                the third number of `command`.
        """

    @abstractmethod
    def place(
        self, terrain: torch.Tensor, level: torch.Tensor, variant: torch.Tensor | None = None
    ) -> None:
        """Choose the ground of every world, from its next reset on and for good.

        Args:
            terrain: Index into `terrains`, (N,).
            level: Difficulty level, (N,).
            variant: Of the tile, (N,); None deals the variants to the worlds in turn.

        Raises:
            ValueError: All ground is flat.
        """

    @abstractmethod
    def set_task(self, skill: torch.Tensor, command: torch.Tensor) -> TensorDict:
        """Give every world a new skill (N,) and command (N, 3); return the observation of it."""

    @abstractmethod
    def set_skill_probabilities(self, probabilities: torch.Tensor) -> None:
        """Set the probabilities with which new skills are drawn, (S,)."""

    def set_progress(self, progress: float) -> None:
        """Set what changes over a phase to its value at this share of it, in [0, 1]."""

    @abstractmethod
    def keyframe_observations(self) -> torch.Tensor:
        """Return critic observations at rest in each keyframe.

        Returns:
            Observations for G commands spread over the command range, (S, G, C).
        """

    def robot_identity(self) -> dict:
        """Return what a training depends on of the robot, as plain values."""
        return {}

    def robot_change(self, before: dict) -> str | None:
        """Return how the robot differs from an earlier `robot_identity`, None if it does not."""
        return None

    def name_term(self, group: str, column: int) -> str:
        """Name what a column of a group of observations comes from, for messages."""
        return f"column {column} of observation group {group}"

    @abstractmethod
    def measure(self) -> Measurements:
        """Return the measurements of the last step.

        Raises:
            RuntimeError: No step was made yet.
        """

    @abstractmethod
    def foot_pos_b(self, joint_pos: torch.Tensor) -> torch.Tensor:
        """Return the centres of the feet in the base frame, (N, F, 3), m.

        Args:
            joint_pos: Joint angles, (N, J), rad.
        """

    @abstractmethod
    def foot_height_b(self, gravity_b: torch.Tensor, joint_pos: torch.Tensor) -> torch.Tensor:
        """Return the height of each foot's lowest point above the base, (N, F), m.

        Args:
            gravity_b: Unit vector of gravity in the base frame, (N, 3).
            joint_pos: Joint angles, (N, J), rad.
        """

    @abstractmethod
    def describe(self) -> dict:
        """Return what a deployed policy must know, as kiras_rl.deploy.metadata spells it."""

    @abstractmethod
    def state_dict(self) -> dict:
        """Return everything the next steps depend on: tensors and plain numbers only."""

    @abstractmethod
    def load_state_dict(self, state: dict) -> None:
        """Go on from a saved state."""
