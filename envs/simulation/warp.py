"""MuJoCo-Warp: the default on a GPU, and on a CPU the twin by which that path is tested.

The kernels are compiled when they are first used, which takes minutes, and kept for later processes
in Warp's cache: ~/.cache/warp, or the folder that WARP_CACHE_PATH names.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import gc
import logging
from collections.abc import Callable, Iterator
from typing import no_type_check

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp

from kiras_rl.envs.simulation.base import RANDOMISED_FIELDS
from kiras_rl.envs.simulation.overflow import OverflowMonitor
from kiras_rl.envs.terrain_geoms import TERRAIN_FIELDS, TerrainGeoms

_log = logging.getLogger(__name__)
wp.config.log_level = wp.LOG_WARNING  # else a line on standard output for each of 70 modules

# Everything that loses contacts or constraints; the two others only end the solver early.
_OVERFLOW = int(
    mjw.OverflowType.ALL & ~(mjw.OverflowType.ITERATIONS | mjw.OverflowType.LS_ITERATIONS)
)

_Bits = mjw.OverflowType
_BUDGETS = {
    int(_Bits.BROADPHASE | _Bits.NARROWPHASE): "too few contacts, raise sim.max_contacts,",
    int(_Bits.NEFC | _Bits.NJMAX_NNZ): "too few constraint rows, raise sim.max_constraints,",
    int(_Bits.CCD | _Bits.EPA_HORIZON): "too few pairs with a height field, raise sim.max_ccd,",
    int(_Bits.HFIELD): "too fine a height field, raise env.terrain.cell,",
}
"""What overflowed, and the key to change."""


@wp.kernel
@no_type_check  # the body of a kernel is Warp's language
def _add_contact_forces(
    force: wp.array[wp.spatial_vector],
    geom: wp.array[wp.vec2i],
    world: wp.array[int],
    count: wp.array[int],
    column: wp.array[int],
    record: wp.array2d[float],
) -> None:
    """Add the force of each contact, in the world frame, to the sensors of its two geoms."""
    contact = wp.tid()
    if contact >= count[0]:
        return
    for side in range(2):
        first = column[geom[contact][side]]
        if first >= 0:
            sign = 1.0 - 2.0 * float(side)  # the force is that on the first geom
            for i in range(3):
                wp.atomic_add(record, world[contact], first + i, sign * force[contact][i])


@wp.kernel
@no_type_check
def _read_warnings(
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    ctrl: wp.array2d[float],
    lost: int,
    overflow: wp.array[int],
    seen: wp.array[int],
    diverged: wp.array[wp.bool],
    overflowed: wp.array[wp.bool],
) -> None:
    """Tell which worlds broke, by their state and by what of `overflow` loses contacts."""
    world = wp.tid()
    limit = float(mujoco.mjMAXVAL)  # what MuJoCo itself calls bad; NaN is not below it either
    broken = int(0)  # noqa: UP018, RUF046, a variable of Warp and not a constant
    for i in range(qpos.shape[1]):
        broken += wp.where(wp.abs(qpos[world, i]) <= limit, 0, 1)
    for i in range(qvel.shape[1]):
        broken += wp.where(wp.abs(qvel[world, i]) <= limit, 0, 1)
    for i in range(ctrl.shape[1]):
        broken += wp.where(wp.abs(ctrl[world, i]) <= limit, 0, 1)
    bits = overflow[world]
    diverged[world] = broken > 0
    overflowed[world] = (bits & lost) != 0
    seen[world] = seen[world] | bits
    overflow[world] = 0


class WarpSimulation:
    """The Simulation protocol over `mujoco_warp`; see base.py for the members.

    The launches of a control step are fixed: they are recorded once and replayed, on CUDA without
    waiting for the device.

    Contact memory is one pool of `num_worlds * max_contacts`: when it overflows, all worlds count
    as overflowed. Constraint memory belongs to each world.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        num_worlds: int,
        substeps: int,
        device: torch.device,
        max_contacts: int,
        max_constraints: int,
        max_ccd: int | None = None,
        terrain: TerrainGeoms | None = None,
        capture: bool = True,
        fields: tuple[str, ...] = (),
    ) -> None:
        """Allocate the worlds, compile the kernels and record the launches.

        Args:
            model: The scene with the sensors that the environment reads.
            num_worlds: N.
            substeps: Physics steps in a control step, K.
            device: A CUDA device or the CPU.
            max_contacts: Contacts, the mean over all worlds.
            max_constraints: Constraint rows a world.
            max_ccd: Pairs of a geom and a height field, the mean over all worlds.
            terrain: The tiles that a world may show, if the scene has any.
            capture: Replay recorded launches; otherwise launch kernel by kernel, for debugging.
            fields: Of MjModel, to hold one value a world beside RANDOMISED_FIELDS.
        """
        self._randomised = tuple(dict.fromkeys((*RANDOMISED_FIELDS, *fields)))
        self.model = model
        self.num_worlds = num_worlds
        self.device = device
        self._substeps = substeps
        self._warp_device = wp.get_device(str(device))
        with wp.ScopedDevice(self._warp_device):
            self._allocate(max_contacts, max_constraints, max_ccd, terrain)
        wp.synchronize_device(self._warp_device)  # torch continues on a stream of its own
        self._bind_state()
        self._bind_terrain(terrain)
        self._record_launches(capture)

    def _allocate(
        self,
        max_contacts: int,
        max_constraints: int,
        max_ccd: int | None,
        terrain: TerrainGeoms | None,
    ) -> None:
        n = self.num_worlds
        fields = self._randomised + (TERRAIN_FIELDS if terrain else ())
        sizes: dict[str, int] = dict.fromkeys(fields, n)
        model, columns = _without_contact_sensors(self.model)
        self._m = mjw.put_model(model, batch_sizes=sizes)
        self._m.opt.warn_overflow = 0  # printed by the kernels; counted here instead
        # The slowest world takes nearly all iterations, and a graph that asks after each whether
        # to go on costs more than the iterations that it saves, and keeps the host waiting.
        self._m.opt.graph_conditional = False
        if max_ccd is not None:
            max_ccd = min(max_ccd, max_contacts)
        self._d = mjw.make_data(
            self.model, n, nconmax=max_contacts, njmax=max_constraints, nccdmax=max_ccd
        )
        self._record = wp.zeros((self._substeps, n, self.model.nsensordata), dtype=float)
        contacts = self._d.naconmax
        self._contact_ids = wp.array(np.arange(contacts, dtype=np.int32))
        self._contact_force = wp.array(np.zeros((contacts, 6)), dtype=wp.spatial_vector)
        self._columns = wp.array(columns)

    def _bind_state(self) -> None:
        """Make tensors that share memory with Warp's arrays: written in place, never replaced."""
        data = self._d
        self.qpos, self.qvel = wp.to_torch(data.qpos), wp.to_torch(data.qvel)
        self._ctrl, self._time = wp.to_torch(data.ctrl), wp.to_torch(data.time)
        self._warmstart = wp.to_torch(data.qacc_warmstart)
        self._overflow = wp.to_torch(data.overflow)
        self.sensor_record = wp.to_torch(self._record).transpose(0, 1)
        self.overflowed = torch.zeros(self.num_worlds, dtype=torch.bool, device=self.device)
        self.diverged = torch.zeros_like(self.overflowed)
        self._monitor = OverflowMonitor(_BUDGETS, self.num_worlds, self.device)
        self._fields = {name: wp.to_torch(getattr(self._m, name)) for name in self._randomised}
        self._state = {
            "qpos": self.qpos,
            "qvel": self.qvel,
            "ctrl": self._ctrl,
            "time": self._time,
            "qacc_warmstart": self._warmstart,
        }
        self._state |= {f"field/{name}": x for name, x in self._fields.items()}
        self._bind_history()

    def _bind_history(self) -> None:
        # One buffer an actuator: [two cursors, n times, n values] (mjData.history).
        self._history_samples = int(self.model.actuator_history[:, 0].max(initial=0))
        if not self._history_samples:
            return
        shape = (self.model.nu, 2 + 2 * self._history_samples)
        fresh = mujoco.MjData(self.model).history.reshape(shape)
        self._fresh_history = torch.tensor(fresh, dtype=torch.float32, device=self.device)
        self._history = wp.to_torch(self._d.history).view(self.num_worlds, *shape)
        self._state["history"] = self._history

    def _bind_terrain(self, terrain: TerrainGeoms | None) -> None:
        self._tile = torch.zeros(self.num_worlds, dtype=torch.int64, device=self.device)
        self._state["tile"] = self._tile
        self._terrain_tables: list[tuple[torch.Tensor, torch.Tensor]] = []
        if terrain is None:
            return
        for name, values in terrain.fields.items():
            # A bounding box is two vectors in Warp: its centre and its half sizes.
            field = wp.to_torch(getattr(self._m, name))
            table = torch.tensor(values, device=self.device).to(field.dtype)
            target = field[:, terrain.geoms]
            self._terrain_tables.append((target, table.view(len(table), *target.shape[1:])))
            if name == "geom_pos":  # positions of geoms that cannot move are computed only once
                placed = wp.to_torch(self._d.geom_xpos)[:, terrain.geoms]
                self._terrain_tables.append((placed, table.float()))
        self._show_tiles()

    def _show_tiles(self) -> None:
        for target, table in self._terrain_tables:
            target.copy_(table[self._tile])

    def _record_launches(self, capture: bool) -> None:
        reason = _obstacle_to_capture(self._warp_device)
        if capture and reason:
            _log.warning("No CUDA graphs: %s. Physics will be several times slower", reason)
            capture = False
        _log.info("Preparing the kernels of MuJoCo-Warp: minutes the first time, seconds later")
        initial = self.state_dict()
        self._control_step = Launches(self._launch_control_step, self._warp_device, capture)
        self.load_state_dict(initial)
        self.sensor_record.zero_()

    def _launch_control_step(self) -> None:
        data = self._d
        for k in range(self._substeps):
            mjw.step(self._m, data)
            # Warp's types allow for an indexed array, which only a list of indices makes
            record: wp.array = self._record[k]  # pyright: ignore[reportAssignmentType]
            wp.copy(record, data.sensordata)
            self._launch_contact_forces(record)
        wp.launch(
            _read_warnings,
            dim=self.num_worlds,
            inputs=[data.qpos, data.qvel, data.ctrl, _OVERFLOW, data.overflow],
            outputs=[
                wp.from_torch(x) for x in (self._monitor.seen, self.diverged, self.overflowed)
            ],
        )

    def _launch_contact_forces(self, record: wp.array) -> None:
        data, contact = self._d, self._d.contact
        mjw.contact_force(self._m, data, self._contact_ids, True, self._contact_force)
        wp.launch(
            _add_contact_forces,
            dim=data.naconmax,
            inputs=[self._contact_force, contact.geom, contact.worldid, data.nacon, self._columns],
            outputs=[record],
        )

    def step(self, ctrl: torch.Tensor) -> None:
        """Advance every world by one control step."""
        self._ctrl.copy_(ctrl)
        self._control_step()
        self._monitor.look()

    def write_state(
        self, mask: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor, ctrl: torch.Tensor
    ) -> None:
        """Set the state of the masked worlds and forget their past."""
        _write(self.qpos, mask, qpos)
        _write(self.qvel, mask, qvel)
        _write(self._ctrl, mask, ctrl)
        self._warmstart.masked_fill_(mask[:, None], 0.0)
        self._time.masked_fill_(mask, 0.0)
        if self._history_samples:
            history = self._fresh_history.repeat(self.num_worlds, 1, 1)
            history[..., 2 + self._history_samples :] = ctrl[..., None]
            _write(self._history, mask, history)

    def write_velocity(self, mask: torch.Tensor, qvel: torch.Tensor) -> None:
        """Set the velocities of the masked worlds."""
        _write(self.qvel, mask, qvel)

    def write_field(self, name: str, mask: torch.Tensor, values: torch.Tensor) -> None:
        """Set a field that holds one value a world in the masked worlds."""
        _write(self._fields[name], mask, values)

    def write_terrain(self, mask: torch.Tensor, tile: torch.Tensor) -> None:
        """Show a tile in the masked worlds."""
        _write(self._tile, mask, tile)
        self._show_tiles()

    def usage(self) -> dict[str, float]:
        """Return what the last physics step took of the budgets, by key; waits for the device.

        `max_contacts` bounds the pairs that are near each other, too. Of both the mean of all
        worlds counts, of `max_constraints` the largest world.
        """
        data = self._d
        contacts = max(data.ncollision.numpy()[0], data.nacon.numpy()[0])
        return {
            "max_contacts": float(contacts) / self.num_worlds,
            "max_constraints": float(data.nefc.numpy().max()),
        }

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return all that the next steps depend on."""
        return {name: x.clone() for name, x in self._state.items()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Go on from a saved state."""
        for name, x in self._state.items():
            x.copy_(state[name])
        self._show_tiles()
        self._overflow.zero_()


class Launches:
    """A fixed sequence of kernel launches, on the stream that torch uses at the call."""

    def __init__(self, launch: Callable[[], None], device: wp.Device, capture: bool) -> None:
        """Launch once, which compiles and loads the kernels, then record."""
        self._launch, self._device = launch, device
        self._graph: wp.Graph | None = None
        self()
        if capture:
            recording = wp.ScopedCapture(device, force_module_load=False)
            with _garbage_kept(), wp.ScopedDevice(device), recording:
                launch()
            self._graph = recording.graph

    def __call__(self) -> None:
        """Launch, without waiting."""
        with self._scope():
            if self._graph is None:
                self._launch()
            else:
                wp.capture_launch(self._graph)

    def _scope(self) -> contextlib.AbstractContextManager:
        if self._device.is_cpu:
            return wp.ScopedDevice(self._device)
        stream = torch.cuda.current_stream(wp.device_to_torch(self._device))
        return wp.ScopedStream(_warp_stream(stream), sync_enter=False)


_warp_stream = functools.lru_cache(maxsize=None)(wp.stream_from_torch)


def _without_contact_sensors(model: mujoco.MjModel) -> tuple[mujoco.MjModel, np.ndarray]:
    """Return the model without its sensors of net contact forces, which are added up here.

    mujoco_warp sorts the contacts of every sensor first, which takes an eighth of a step.

    Returns:
        The model, and for each geom the column of its sensor in the sensor data, -1 for none.
    """
    model = copy.copy(model)
    columns = np.full(model.ngeom, -1, dtype=np.int32)
    ids = np.flatnonzero(model.sensor_type == int(mujoco.mjtSensor.mjSENS_CONTACT))
    columns[model.sensor_objid[ids]] = model.sensor_adr[ids]
    model.sensor_type[ids] = int(mujoco.mjtSensor.mjSENS_USER)
    return model, columns


def _obstacle_to_capture(device: wp.Device) -> str | None:
    """Return why launches cannot be recorded on a device, or None."""
    if device.is_cpu:
        return None
    if not wp.is_mempool_enabled(device):
        return f"memory pools are off on {device.name}"
    if not wp.is_conditional_graph_supported():
        return "the NVIDIA driver is older than CUDA 12.4"
    return None


@contextlib.contextmanager
def _garbage_kept() -> Iterator[None]:
    """Suspend garbage collection: what a finalizer frees would become part of the recording."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _write(target: torch.Tensor, mask: torch.Tensor, values: torch.Tensor) -> None:
    """Copy the masked rows of `values` into `target`, (N, ...), without asking which they are."""
    mask = mask.view(-1, *[1] * (target.dim() - 1))
    torch.where(mask, values, target, out=target)
