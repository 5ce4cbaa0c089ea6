"""Domain randomization, drawn anew in every world at every reset.

A share of the episodes is randomized, which may grow over a phase; the others are nominal.

Beside what RandomizationConfig names, `env.randomization.terms` holds functions of `Draw`. Each
says by `randomizing` which fields of MjModel it writes and how many random numbers it takes, and
returns new values of these fields.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import mujoco
import numpy as np
import torch
from torch.quasirandom import SobolEngine

from kiras_rl.config import ConfigError
from kiras_rl.envs.lookup import find_terms
from kiras_rl.envs.model import Scene
from kiras_rl.envs.randomness import JOINTS, Drawing, UniformBuffer, scale_to
from kiras_rl.envs.simulation.base import BODY_FIELDS, Simulation
from kiras_rl.schema import RandomizationConfig

BODIES = 512  # robots of different masses and centres of mass among which worlds draw
BASE_DOFS = 6  # of the free joint, before those of the legs
KP, KD = 4, 6  # columns of a DC motor's gainprm that hold the gains of its controller
TERMS = "randomization"  # group of the random numbers that terms take
VELOCITY = "qvel"  # no field: what a term that writes it returns is written every step

_WHERE = "env.randomization.terms"


@dataclass
class Draw(Drawing):
    """What a randomization may look at.

    Attributes:
        fields: Values so far of what it writes, (N, *shape of the field in MjModel).
        dt: Duration of a control step, s.
    """

    fields: Mapping[str, torch.Tensor]
    dt: float


def randomizing(*fields: str, numbers: int = 0) -> Callable[[Callable], Callable]:
    """Mark a term that writes these fields of MjModel, and takes so many random numbers a world.

    A term that writes VELOCITY alone is asked in every step, and returns what velocities become.
    """

    def mark(term: Callable) -> Callable:
        term.fields, term.numbers = fields, numbers
        return term

    return mark


@randomizing("dof_armature", numbers=JOINTS)
def armature(draw: Draw, factor: tuple[float, float]) -> dict[str, torch.Tensor]:
    """Scale the inertia of each motor by a factor of its own."""
    values = draw.fields["dof_armature"].clone()
    values[:, BASE_DOFS:].mul_(draw.between(factor))
    return {"dof_armature": values}


def find_randomizations(config: RandomizationConfig) -> dict[str, partial[Any]]:
    """Return the terms of a configuration by name.

    Raises:
        ConfigError: Unknown term or parameter, or a function that is not marked by `randomizing`.
    """
    found = find_terms(globals(), config.terms or {}, Draw, _WHERE)
    for name, term in found.items():
        if not getattr(term.func, "fields", ()):
            raise ConfigError(
                f"{_WHERE}.{name}: '{term.func.__name__}' does not say which fields it writes: "
                'mark it, as in @randomizing("dof_armature", numbers=JOINTS)'
            )
    return found


def fields_of(terms: Iterable[partial[Any]], model: mujoco.MjModel) -> tuple[str, ...]:
    """Return the fields that terms write, each once.

    Raises:
        ConfigError: No field of floats in MjModel.
    """
    fields = dict.fromkeys(field for term in terms for field in term.func.fields)
    fields.pop(VELOCITY, None)
    for field in fields:
        values = getattr(model, field, None)
        if not isinstance(values, np.ndarray) or values.dtype.kind != "f":
            raise ConfigError(f"{_WHERE}: '{field}' is no field of numbers in MjModel")
    return tuple(fields)


def columns(num_joints: int) -> dict[str, int]:
    """Return the random numbers that this module takes each step."""
    return {
        "randomized": 1,
        "friction": 1,
        "body": 1,
        "kp_factor": 1,
        "kd_factor": 1,
        "motor_factor": num_joints,
        "torque_factor": 1,
        "joint_friction_factor": num_joints,
        "joint_damping_factor": num_joints,
        "action_delay": 1,
        "push": 2,
        "push_chance": 1,
    }


class Randomizer:
    """Writes model fields of the worlds that reset, and pushes bases now and then.

    Attributes:
        share: Of the episodes that are randomized, ().
    """

    def __init__(
        self,
        config: RandomizationConfig,
        scene: Scene,
        sim: Simulation,
        random: UniformBuffer,
        terms: Mapping[str, partial[Any]] | None = None,
        step_dt: float = 0.0,
    ) -> None:
        """Remember the nominal values.

        Args:
            config: What is drawn.
            scene: Its model is nominal.
            sim: Where it is written.
            random: Numbers of each step.
            terms: Of `find_randomizations`.
            step_dt: Duration of a control step, s.
        """
        self.share = torch.ones((), device=sim.device)
        self._config, self._scene, self._sim, self._random = config, scene, sim, random
        model = scene.model

        def nominal(field: str) -> torch.Tensor:
            values = torch.tensor(getattr(model, field), dtype=torch.float32, device=sim.device)
            return values.expand(sim.num_worlds, *values.shape)

        self._friction = nominal("geom_friction")
        slides = torch.zeros(model.ngeom, 3, dtype=torch.bool)
        slides[scene.robot_geoms, 0] = True
        self._slides = slides.to(sim.device)
        self._bodies = None
        if config.payload or config.com_shift or config.leg_mass_factor:
            fields = draw_bodies(scene, config.payload, config.com_shift, config.leg_mass_factor)
            self._bodies = {  # and as the last row the nominal one
                name: torch.cat([values.to(sim.device), nominal(name)[:1]])
                for name, values in fields.items()
            }
        self._gain = nominal("actuator_gainprm")
        self._delay = nominal("actuator_delay")
        self._limits = nominal("actuator_forcerange")
        self._joints = {name: nominal(name) for name in ("dof_frictionloss", "dof_damping")}
        terms, self._step_dt = terms or {}, step_dt
        self._foot, self._base = scene.robot_geoms[0], scene.base_body
        self._mass = float(model.body_mass[scene.base_body])
        self._terms = {k: term for k, term in terms.items() if term.func.fields != (VELOCITY,)}
        self._kicks = {k: term for k, term in terms.items() if k not in self._terms}
        self._nominal = {name: nominal(name) for name in fields_of(terms.values(), model)}
        self._written: dict[str, torch.Tensor] = {}  # in the reset of the moment
        self._drawn = self.randomized  # then

    @property
    def randomized(self) -> torch.Tensor:
        """Worlds that would be randomized if they began now, (N, 1) bool."""
        return self._random["randomized"] < self.share

    def reset(self, mask: torch.Tensor) -> torch.Tensor:
        """Draw the physics of the masked worlds, (N,) bool; return which are randomized, (N, 1)."""
        config, self._written = self._config, dict(self._nominal)
        self._drawn = self.randomized
        if config.friction:
            self._write_friction(mask, config.friction)
        if self._bodies:
            number = scale_to(self._random["body"], 0.0, BODIES).long()
            number = torch.where(self._drawn, number, BODIES).squeeze(1)
            for name, values in self._bodies.items():
                self._write(name, mask, values[number])
        if config.kp_factor or config.kd_factor or config.motor_factor:
            self._write_gains(mask)
        self._write_joints(mask, "dof_frictionloss", "joint_friction_factor")
        self._write_joints(mask, "dof_damping", "joint_damping_factor")
        if config.torque_factor:
            factor = self._factor("torque_factor")
            self._write("actuator_forcerange", mask, self._limits * factor[:, None])
        if config.action_delay:
            self._write_delay(mask, config.action_delay)
        self._write_terms(mask)
        return self._drawn

    @property
    def physics(self) -> torch.Tensor:
        """Friction, and payload in kg, (N, 2), that the last `reset` drew for every world."""
        friction = self._written.get("geom_friction", self._friction)[:, self._foot, :1]
        if "body_mass" not in self._written:
            return torch.cat([friction, torch.zeros_like(friction)], dim=1)
        mass = self._written["body_mass"][:, self._base, None]
        return torch.cat([friction, mass - self._mass], dim=1)

    def pushes(self, step_dt: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Return which worlds are pushed now, (N,) bool, and the added velocity, (N, 2), m/s."""
        limits = self._config.push_velocity or (0.0, 0.0)
        rate = step_dt / self._config.push_interval if self._config.push_velocity else 0.0
        mask = self._random["push_chance"][:, 0] < rate
        return mask, scale_to(self._random["push"], *limits)

    def kick(self, pushed: torch.Tensor, qvel: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return which velocities terms change, (N,) bool, and what all become, (N, nv).

        Args:
            pushed: Worlds that are pushed now, (N,) bool.
            qvel: Their velocities after it; of the others it does not count.
        """
        if not self._kicks:
            return pushed, qvel
        before = self._sim.qvel
        now = {VELOCITY: torch.where(pushed[:, None], qvel, before)}
        for name, term in self._kicks.items():
            now |= self._ask(name, term, now)
        return (now[VELOCITY] != before).any(dim=1), now[VELOCITY]

    def _write_terms(self, mask: torch.Tensor) -> None:
        for name, term in self._terms.items():
            before = {field: self._written[field] for field in term.func.fields}
            for field, values in self._ask(name, term, before).items():
                chosen = self._drawn.view(-1, *[1] * (values.dim() - 1))
                self._write(field, mask, torch.where(chosen, values, before[field]))

    def _ask(
        self, name: str, term: partial[Any], fields: dict[str, torch.Tensor]
    ) -> dict[str, torch.Tensor]:
        """Return what a term makes of its fields, checked."""
        where = f"{_WHERE}.{name}"
        draw = Draw(self._random[f"{TERMS}/{name}"], where, fields, self._step_dt)
        values = term(draw)
        shapes = {field: tuple(value.shape) for field, value in fields.items()}
        given = values if isinstance(values, dict) else {}
        if {field: tuple(value.shape) for field, value in given.items()} != shapes:
            raise ConfigError(f"{where}: the term has to return a dict of {shapes}")
        return {field: value.float() for field, value in values.items()}

    def _write(self, field: str, mask: torch.Tensor, values: torch.Tensor) -> None:
        self._written[field] = values
        self._sim.write_field(field, mask, values)

    def _factor(self, name: str) -> torch.Tensor:
        """Draw factors of one of the configured ranges, 1 in nominal worlds, (N, 1) or (N, J)."""
        drawn = scale_to(self._random[name], *getattr(self._config, name))
        return torch.where(self._drawn, drawn, 1.0)

    def _write_friction(self, mask: torch.Tensor, limits: tuple[float, float]) -> None:
        friction = scale_to(self._random["friction"], *limits)
        # (N, 1) on every geom of the robot; by a mask: a list of them would be copied to the GPU
        slides = self._slides & self._drawn[..., None]
        values = torch.where(slides, friction[..., None], self._friction)
        self._write("geom_friction", mask, values)

    def _write_gains(self, mask: torch.Tensor) -> None:
        """Scale the gains: of all joints alike, and of each by the strength of its motor."""
        gain, config = self._gain.clone(), self._config
        if config.kp_factor:
            gain[..., KP].mul_(self._factor("kp_factor"))
        if config.kd_factor:
            gain[..., KD].mul_(self._factor("kd_factor"))
        if config.motor_factor:
            strength = self._factor("motor_factor")
            gain[..., KP].mul_(strength)
            gain[..., KD].mul_(strength)
        self._write("actuator_gainprm", mask, gain)

    def _write_joints(self, mask: torch.Tensor, field: str, name: str) -> None:
        """Scale friction or damping, a factor of its own for each joint."""
        if getattr(self._config, name):
            values = self._joints[field].clone()
            values[:, BASE_DOFS:].mul_(self._factor(name))
            self._write(field, mask, values)

    def _write_delay(self, mask: torch.Tensor, limits: tuple[int, int]) -> None:
        """Delay the targets by whole physics steps, one delay for all joints of a world."""
        steps = scale_to(self._random["action_delay"], limits[0], limits[1] + 1).floor()
        # Half a step less than k steps still reads the target of k steps ago, and stays right when
        # float32 time has lost its last digits after 16 s.
        steps = torch.where(self._drawn, steps, 0.0)
        seconds = (steps - 0.5).clamp(min=0.0) * self._scene.model.opt.timestep
        self._write("actuator_delay", mask, seconds.expand_as(self._delay))


def nominal_physics(scene: Scene) -> tuple[float, float]:
    """Return friction and payload in kg of a robot as its MJCF has it; see `Randomizer.physics`."""
    return float(scene.model.geom_friction[scene.robot_geoms[0], 0]), 0.0


def draw_bodies(
    scene: Scene,
    payload: tuple[float, float] | None,
    com_shift: tuple[float, float] | None,
    leg_mass_factor: tuple[float, float] | None = None,
    count: int = BODIES,
) -> dict[str, torch.Tensor]:
    """Return BODY_FIELDS of robots whose base and links weigh something else.

    The base carries a payload and has its centre of mass moved; each link of a leg is heavier or
    lighter by a factor, and so is its inertia.

    What follows from a mass is computed here, by MuJoCo, and once: at a reset a world only copies
    it. Payload and shifts fill their box evenly (Sobol), the same in every run.

    Args:
        scene: Its model is nominal.
        payload: Range of the mass that is added, kg.
        com_shift: Range of the shift along each axis of the base, m.
        leg_mass_factor: Range of the factor of each link.
        count: How many.

    Returns:
        Name -> values, (count, *shape of the field in MjModel).

    Raises:
        ConfigError: A payload that takes away all of the base.
    """
    nominal = scene.model.body_mass[scene.base_body]
    if payload and nominal + payload[0] <= 0:
        raise ConfigError(
            f"env.randomization.payload={list(payload)}: the base weighs {nominal:.2f} kg, so that "
            f"more than {-nominal:.2f} is allowed"
        )
    model, base = copy.copy(scene.model), scene.base_body
    data = mujoco.MjData(model)
    links = [body for body in range(base + 1, model.nbody) if model.body_rootid[body] == base]
    uniform = SobolEngine(4 + len(links), scramble=True, seed=1).draw(count, dtype=torch.float64)
    masses = scale_to(uniform[:, 0], *(payload or (0.0, 0.0))) + nominal
    shift = scale_to(uniform[:, 1:4], *(com_shift or (0.0, 0.0))).numpy()
    factors = scale_to(uniform[:, 4:], *(leg_mass_factor or (1.0, 1.0))).numpy()
    centres = model.body_ipos[base] + shift
    fields = {
        name: np.empty((count, *getattr(model, name).shape), np.float32) for name in BODY_FIELDS
    }
    for k, mass in enumerate(masses.tolist()):
        model.body_mass[base], model.body_ipos[base] = mass, centres[k]
        model.body_mass[links] = scene.model.body_mass[links] * factors[k]
        model.body_inertia[links] = scene.model.body_inertia[links] * factors[k][:, None]
        mujoco.mj_setConst(model, data)
        for name, values in fields.items():
            values[k] = getattr(model, name)
    return {name: torch.from_numpy(values) for name, values in fields.items()}
