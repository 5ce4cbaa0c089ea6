"""Domain randomization: the paper's table, drawn anew in every world at every reset."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
import torch
from torch.quasirandom import SobolEngine

from kiras_rl.config import ConfigError
from kiras_rl.envs.model import Scene
from kiras_rl.envs.randomness import UniformBuffer, scale_to
from kiras_rl.envs.simulation.base import BODY_FIELDS, Simulation
from kiras_rl.schema import RandomizationConfig

COLUMNS = {
    "friction": 1,
    "body": 1,
    "kp_factor": 1,
    "kd_factor": 1,
    "action_delay": 1,
    "push": 2,
    "push_chance": 1,
    "torque_factor": 1,
}
"""Random numbers that this module takes each step."""

BODIES = 512  # bases of different mass and centre of mass among which worlds draw


class Randomizer:
    """Writes model fields of the worlds that reset, and pushes bases now and then."""

    def __init__(
        self, config: RandomizationConfig, scene: Scene, sim: Simulation, random: UniformBuffer
    ) -> None:
        """Remember the nominal values."""
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
        if config.payload or config.com_shift:
            fields = draw_bodies(scene, config.payload, config.com_shift)
            self._bodies = {name: values.to(sim.device) for name, values in fields.items()}
        self._gain, self._bias = nominal("actuator_gainprm"), nominal("actuator_biasprm")
        self._delay = nominal("actuator_delay")
        self._limits = nominal("actuator_forcerange")

    def reset(self, mask: torch.Tensor) -> None:
        """Draw the physics of the masked worlds, (N,) bool."""
        config = self._config
        if config.friction:
            self._write_friction(mask, self._draw("friction", config.friction))
        if self._bodies:
            number = scale_to(self._random["body"][:, 0], 0.0, BODIES).long()
            for name, values in self._bodies.items():
                self._sim.write_field(name, mask, values[number])
        if config.kp_factor or config.kd_factor:
            self._write_gains(mask)
        if config.torque_factor:
            factor = self._draw("torque_factor", config.torque_factor)
            self._sim.write_field("actuator_forcerange", mask, self._limits * factor[:, None])
        if config.action_delay:
            self._write_delay(mask, config.action_delay)

    def pushes(self, step_dt: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Return which worlds are pushed now, (N,) bool, and the added velocity, (N, 2), m/s."""
        limits = self._config.push_velocity or (0.0, 0.0)
        rate = step_dt / self._config.push_interval if self._config.push_velocity else 0.0
        mask = self._random["push_chance"][:, 0] < rate
        return mask, scale_to(self._random["push"], *limits)

    def _draw(self, column: str, limits: tuple[float, float] | None) -> torch.Tensor | None:
        return None if limits is None else scale_to(self._random[column], *limits)

    def _write_friction(self, mask: torch.Tensor, friction: torch.Tensor) -> None:
        # (N, 1) on every geom of the robot; by a mask: a list of them would be copied to the GPU
        values = torch.where(self._slides, friction[..., None], self._friction)
        self._sim.write_field("geom_friction", mask, values)

    def _write_gains(self, mask: torch.Tensor) -> None:
        """Scale a position actuator: gain kp, bias (0, -kp, -kd)."""
        gain, bias = self._gain.clone(), self._bias.clone()
        kp = self._draw("kp_factor", self._config.kp_factor)
        kd = self._draw("kd_factor", self._config.kd_factor)
        if kp is not None:
            gain[..., 0].mul_(kp)
            bias[..., 1].mul_(kp)
        if kd is not None:
            bias[..., 2].mul_(kd)
        self._sim.write_field("actuator_gainprm", mask, gain)
        self._sim.write_field("actuator_biasprm", mask, bias)

    def _write_delay(self, mask: torch.Tensor, limits: tuple[int, int]) -> None:
        """Delay the targets by whole physics steps, one delay for all joints of a world."""
        steps = scale_to(self._random["action_delay"], limits[0], limits[1] + 1).floor()
        # Half a step less than k steps still reads the target of k steps ago, and stays right when
        # float32 time has lost its last digits after 16 s.
        seconds = (steps - 0.5).clamp(min=0.0) * self._scene.model.opt.timestep
        self._sim.write_field("actuator_delay", mask, seconds.expand_as(self._delay))


def draw_bodies(
    scene: Scene,
    payload: tuple[float, float] | None,
    com_shift: tuple[float, float] | None,
    count: int = BODIES,
) -> dict[str, torch.Tensor]:
    """Return BODY_FIELDS of robots whose base carries a payload and has its centre of mass moved.

    What follows from a mass is computed here, by MuJoCo, and once: at a reset a world only copies
    it. Payload and shifts fill their box evenly (Sobol), the same in every run.

    Args:
        scene: Its model is nominal.
        payload: Range of the mass that is added, kg.
        com_shift: Range of the shift along each axis of the base, m.
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
    uniform = SobolEngine(4, scramble=True, seed=1).draw(count, dtype=torch.float64)
    masses = scale_to(uniform[:, 0], *(payload or (0.0, 0.0))) + nominal
    shift = scale_to(uniform[:, 1:], *(com_shift or (0.0, 0.0))).numpy()
    centres = model.body_ipos[base] + shift
    fields = {
        name: np.empty((count, *getattr(model, name).shape), np.float32) for name in BODY_FIELDS
    }
    for k, mass in enumerate(masses.tolist()):
        model.body_mass[base], model.body_ipos[base] = mass, centres[k]
        mujoco.mj_setConst(model, data)
        for name, values in fields.items():
            values[k] = getattr(model, name)
    return {name: torch.from_numpy(values) for name, values in fields.items()}
