"""Forward kinematics of the feet for whole batches: how high they are, where a reset puts the base.

Computed here and not by the simulation, which would have to go through all of its position stage
again after resets.
"""

from __future__ import annotations

import itertools

import mujoco
import numpy as np
import torch

from kiras_rl.robots.robot import Robot, RobotError

_TOLERANCE = 1e-4  # m


class FootKinematics:
    """Chains of hinges from the base to each foot; all chains have the same length.

    A hinge turns a vector v into a (a.v) + cos(q) (v - a (a.v)) + sin(q) a x v (Rodrigues), so a
    foot's position is linear in the products of (1, cos, sin) over its joints. The coefficients are
    computed once: what remains each step is one matrix product.

    Letters: F feet, L links of a chain, J joints.
    """

    def __init__(self, model: mujoco.MjModel, robot: Robot, device: torch.device) -> None:
        """Read the chains from the compiled model.

        Raises:
            RobotError: Legs that are no chains of hinges through the origins of parallel frames.
        """
        chains = [_chain(model, robot, foot) for foot in robot.foot_geoms]
        factors = [_factors(chain["joints"], len(robot.joint_names)) for chain in chains]
        self._factors = torch.tensor(np.concatenate(factors, axis=1), device=device)  # (L, F 3^L)
        coefficients = [torch.tensor(_coefficients(chain), device=device) for chain in chains]
        self._coefficients = torch.block_diag(*coefficients).float()  # (F 3^L, F 3)
        self._radius = robot.foot_radius
        self._check(model, robot, device)

    def _check(self, model: mujoco.MjModel, robot: Robot, device: torch.device) -> None:
        """Compare a pose with MuJoCo's."""
        data = mujoco.MjData(model)
        joint_pos = robot.default_joint_pos + 0.3
        data.qpos[:] = np.concatenate([np.zeros(3), [1.0, 0.0, 0.0, 0.0], joint_pos])
        mujoco.mj_kinematics(model, data)
        feet = np.array([data.geom(name).xpos for name in robot.foot_geoms])
        given = torch.tensor(joint_pos, dtype=torch.float32, device=device)
        mine = self.foot_pos_b(given[None])[0].cpu().numpy()
        distance = np.linalg.norm(mine - feet, axis=1).max()
        if distance > _TOLERANCE:
            raise RobotError(
                f"{robot.name}: a foot is {100 * distance:.1f} cm from where hinges through the "
                "origins of its bodies, whose frames are parallel at angle 0, put it: in the MJCF "
                "leave out pos of the legs' joints and euler, quat and axisangle of their bodies"
            )

    def foot_pos_b(self, joint_pos: torch.Tensor) -> torch.Tensor:
        """Return the centres of the feet in the base frame, (N, F, 3), m.

        Args:
            joint_pos: Joint angles, (N, J), rad.
        """
        one = torch.ones_like(joint_pos[:, :1])
        turns = torch.cat([one, joint_pos.cos(), joint_pos.sin()], dim=1)
        products = turns.index_select(1, self._factors[0])
        for columns in self._factors[1:]:
            products = products * turns.index_select(1, columns)
        return (products @ self._coefficients).unflatten(1, (-1, 3))

    def foot_height_b(self, gravity_b: torch.Tensor, joint_pos: torch.Tensor) -> torch.Tensor:
        """Return the height of each foot's lowest point above the base, (N, F), m.

        Args:
            gravity_b: Unit vector of gravity in the base frame, (N, 3).
            joint_pos: Joint angles, (N, J), rad.
        """
        return -(gravity_b[:, None] * self.foot_pos_b(joint_pos)).sum(-1) - self._radius

    def lowest_foot(self, pitch: torch.Tensor, joint_pos: torch.Tensor) -> torch.Tensor:
        """Return the height of the lowest foot below a base pitched by (N,) rad, (N,), m."""
        pos = self.foot_pos_b(joint_pos)
        height = -torch.sin(pitch)[:, None] * pos[..., 0] + torch.cos(pitch)[:, None] * pos[..., 2]
        return height.amin(dim=1) - self._radius


def _chain(model: mujoco.MjModel, robot: Robot, foot: str) -> dict[str, list]:
    geom = model.geom(foot)
    chain: dict[str, list] = {"joints": [], "axes": [], "offsets": [], "foot": geom.pos.copy()}
    body = int(geom.bodyid[0])
    base = model.body(robot.base_body).id
    while body != base:
        if model.body_jntnum[body] == 0:  # welded: a part of what it hangs on
            ends = chain["offsets"] or [chain["foot"]]
            ends[0] += model.body_pos[body]
            body = int(model.body_parentid[body])
            continue
        joint = model.joint(int(model.body_jntadr[body]))
        chain["joints"].insert(0, robot.joint_names.index(joint.name))
        chain["axes"].insert(0, list(joint.axis))
        chain["offsets"].insert(0, model.body_pos[body].copy())
        body = int(model.body_parentid[body])
    return chain


def _factors(joints: list[int], num_joints: int) -> np.ndarray:
    """Return the columns of (1, cos, sin of every joint) that make the products, (L, 3^L)."""
    choices = [(0, 1 + joint, 1 + num_joints + joint) for joint in joints]
    return np.array(list(itertools.product(*choices))).T


def _coefficients(chain: dict[str, list]) -> np.ndarray:
    """Return what each product adds to the position of the foot, (3^L, 3), m."""
    terms = np.array([chain["foot"]])
    for axis, offset in zip(reversed(chain["axes"]), reversed(chain["offsets"]), strict=True):
        along = np.outer(terms @ axis, axis)
        terms = np.concatenate([along, terms - along, np.cross(axis, terms)])
        terms[0] += offset
    return terms
