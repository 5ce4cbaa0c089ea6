"""The protocol between the environment and a physics backend.

Both backends step N copies of one MuJoCo model and hand out the same two things as torch tensors
on the environment's device: the state, and the sensors of every physics step of the last control
step. Nothing is computed between control steps: what follows from the state alone, the environment
computes itself (kinematics.py).
"""

from __future__ import annotations

from typing import Protocol

import mujoco
import torch

BODY_FIELDS = (
    "body_mass",
    "body_ipos",
    "body_inertia",
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
)
"""Masses, centres of mass, inertias, and the constants that follow from them (mj_setConst)."""

RANDOMISED_FIELDS = (
    *BODY_FIELDS,
    "geom_friction",
    "actuator_gainprm",
    "actuator_delay",
    "actuator_forcerange",
    "dof_frictionloss",
    "dof_damping",
)
"""Fields of MjModel that hold one value a world in any simulation; one may be built with more."""

OVERFLOW_WARNINGS = (mujoco.mjtWarning.mjWARN_CONTACTFULL, mujoco.mjtWarning.mjWARN_CNSTRFULL)
"""Warnings that mean lost contacts: the physics of that world went on without them."""


class Simulation(Protocol):
    """N worlds of one model.

    Letters: N worlds, K physics steps in a control step, S numbers of sensor data.
    """

    model: mujoco.MjModel
    num_worlds: int
    device: torch.device

    qpos: torch.Tensor
    """Positions after the last step or write, (N, nq); quaternions (w, x, y, z)."""

    qvel: torch.Tensor
    """Velocities after the last step or write, (N, nv); base linear in the world frame, base
    angular in the base frame."""

    sensor_record: torch.Tensor
    """Sensor data of each physics step of the last control step, (N, K, S). Sensors are taken
    before each integration: the last ones are a physics step older than `qpos` and `qvel`."""

    overflowed: torch.Tensor
    """Worlds that ran out of contact or constraint memory in the last step, (N,) bool."""

    diverged: torch.Tensor
    """Worlds whose state is not finite or was declared bad by MuJoCo, (N,) bool."""

    def step(self, ctrl: torch.Tensor) -> None:
        """Advance every world by one control step.

        Args:
            ctrl: Position targets of the actuators, (N, nu), rad.
        """
        ...

    def write_state(
        self, mask: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor, ctrl: torch.Tensor
    ) -> None:
        """Set the state of the masked worlds and forget their past.

        Clears warm starts and time, and fills the actuation delay with `ctrl`, so that the first
        delayed targets are not zero angles.

        Args:
            mask: Worlds to write, (N,) bool.
            qpos: Positions, (N, nq). Rows outside the mask are ignored.
            qvel: Velocities, (N, nv).
            ctrl: Position targets of the past, (N, nu), rad.
        """
        ...

    def write_velocity(self, mask: torch.Tensor, qvel: torch.Tensor) -> None:
        """Set the velocities of the masked worlds, (N, nv)."""
        ...

    def write_field(self, name: str, mask: torch.Tensor, values: torch.Tensor) -> None:
        """Set a field that holds one value a world; those of BODY_FIELDS belong together.

        Args:
            name: Field of MjModel.
            mask: Worlds to write, (N,) bool.
            values: New values, (N, *shape of the field in MjModel).
        """
        ...

    def write_terrain(self, mask: torch.Tensor, tile: torch.Tensor) -> None:
        """Show a tile in the masked worlds; all start on tile 0. Needs a scene with terrain.

        Args:
            mask: Worlds to write, (N,) bool.
            tile: Numbers of tiles in the scene's library, (N,) int64.
        """
        ...

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return all that the next steps depend on."""
        ...

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Go on from a saved state."""
        ...
