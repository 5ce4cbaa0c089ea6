"""C MuJoCo on every core, through `mujoco.batch`: the default on a CPU."""

from __future__ import annotations

import copy
import logging
import os

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch

from kiras_rl.envs.simulation.base import OVERFLOW_WARNINGS, RANDOMISED_FIELDS
from kiras_rl.envs.terrain_geoms import TERRAIN_FIELDS, TerrainGeoms
from kiras_rl.robots.scene import hear_warnings

_log = logging.getLogger(__name__)

_OVERFLOW = [int(w) for w in OVERFLOW_WARNINGS]
# All others: a rollout ends early in a world that MuJoCo warns of, so none may pass unseen.
_BAD_STATE = [i for i in range(int(mujoco.mjtWarning.mjNWARNING)) if i not in _OVERFLOW]


class NativeSimulation:
    """The Simulation protocol over `mujoco.batch.Batch`; see base.py for the members.

    States live in float64 inside the batch and are handed out as float32 tensors. Results do not
    depend on the number of threads.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        num_worlds: int,
        substeps: int,
        threads: int = 0,
        terrain: TerrainGeoms | None = None,
        fields: tuple[str, ...] = (),
    ) -> None:
        """Allocate the worlds.

        Args:
            model: The scene with the sensors that the environment reads.
            num_worlds: N.
            substeps: Physics steps in a control step, K.
            threads: Threads of the pool; 0 for one on each core that this process may use.
            terrain: The tiles that a world may show, if the scene has any.
            fields: Of MjModel, to hold one value a world beside RANDOMISED_FIELDS.
        """
        self.model = model = copy.copy(model)
        # A diverged world must stay visible: MuJoCo would silently reset it.
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        hear_warnings()
        self.num_worlds = num_worlds
        self.device = torch.device("cpu")
        self._substeps = substeps
        # MuJoCo itself would take all cores of the machine, also those that this process may not.
        self._batch = Batch(model, num_worlds, threads or len(os.sched_getaffinity(0)))
        self._batch.reset(stage=int(mujoco.mjtStage.mjSTAGE_NONE))
        self._fields = {
            name: self._batch.expand(name) for name in dict.fromkeys((*RANDOMISED_FIELDS, *fields))
        }
        self._bind_state()
        self._allocate_outputs()
        self._bind_terrain(terrain)

    def _bind_state(self) -> None:
        batch = self._batch
        self._qpos, self._qvel = batch.bind("qpos"), batch.bind("qvel")
        self._ctrl, self._time = batch.bind("ctrl"), batch.bind("time")
        self._warmstart = batch.bind("qacc_warmstart")
        self._history_samples = int(self.model.actuator_history[:, 0].max(initial=0))
        self._history = batch.bind("history") if self._history_samples else None
        fresh = mujoco.MjData(self.model).history
        self._fresh_history = fresh.reshape(self.model.nu, -1).copy()

    def _bind_terrain(self, terrain: TerrainGeoms | None) -> None:
        self._tile = np.zeros(self.num_worlds, dtype=np.int64)
        self._terrain_tables: list[tuple[np.ndarray, np.ndarray]] = []
        if terrain is not None:
            for name in TERRAIN_FIELDS:
                field = self._batch.expand(name)[:, terrain.geoms]
                self._terrain_tables.append((field, terrain.fields[name]))
            self._show_tiles(slice(None))

    def _show_tiles(self, rows: np.ndarray | slice) -> None:
        for field, table in self._terrain_tables:
            field[rows] = table[self._tile[rows]]

    def _allocate_outputs(self) -> None:
        n, model = self.num_worlds, self.model
        self._record = np.zeros((n, self._substeps, model.nsensordata))
        self._warnings = np.zeros_like(self._batch.warning[..., 1])
        self.qpos = torch.zeros(n, model.nq)
        self.qvel = torch.zeros(n, model.nv)
        self.sensor_record = torch.zeros(n, self._substeps, model.nsensordata)
        self.overflowed = torch.zeros(n, dtype=torch.bool)
        self.diverged = torch.zeros(n, dtype=torch.bool)

    def step(self, ctrl: torch.Tensor) -> None:
        """Advance every world by one control step."""
        self._ctrl[:] = ctrl.numpy()
        self._warnings[:] = self._batch.warning[..., 1]  # mjWarningStat.number
        self._batch.rollout(self._substeps, record=["sensordata"], out={"sensordata": self._record})
        self.sensor_record.numpy()[:] = self._record
        self._read_state()
        self._read_warnings()

    def _read_state(self) -> None:
        self.qpos.numpy()[:] = self._qpos
        self.qvel.numpy()[:] = self._qvel

    def _read_warnings(self) -> None:
        risen = self._batch.warning[..., 1] > self._warnings
        finite = np.isfinite(self._qpos).all(1) & np.isfinite(self._qvel).all(1)
        self.overflowed.copy_(torch.from_numpy(risen[:, _OVERFLOW].any(1)))
        self.diverged.copy_(torch.from_numpy(risen[:, _BAD_STATE].any(1) | ~finite))

    def write_state(
        self, mask: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor, ctrl: torch.Tensor
    ) -> None:
        """Set the state of the masked worlds and forget their past."""
        ids = mask.nonzero().squeeze(1)
        rows = ids.numpy()
        self._qpos[rows] = qpos[ids].numpy()
        self._qvel[rows] = qvel[ids].numpy()
        self._ctrl[rows] = ctrl[ids].numpy()
        self._warmstart[rows] = 0.0
        self._time[rows] = 0.0
        if self._history is not None:
            self._fill_history(self._history, rows, ctrl[ids].numpy())
        self.qpos[ids], self.qvel[ids] = qpos[ids], qvel[ids]

    def _fill_history(self, history: np.ndarray, rows: np.ndarray, ctrl: np.ndarray) -> None:
        # One buffer an actuator: [two cursors, n times, n values] (mjData.history).
        n = self._history_samples
        buffers = history.reshape(self.num_worlds, self.model.nu, 2 + 2 * n)
        buffers[rows] = self._fresh_history
        buffers[rows, :, 2 + n :] = ctrl[:, :, None]

    def write_velocity(self, mask: torch.Tensor, qvel: torch.Tensor) -> None:
        """Set the velocities of the masked worlds."""
        ids = mask.nonzero().squeeze(1)
        self._qvel[ids.numpy()] = qvel[ids].numpy()
        self.qvel[ids] = qvel[ids]

    def write_field(self, name: str, mask: torch.Tensor, values: torch.Tensor) -> None:
        """Set a field that holds one value a world in the masked worlds."""
        ids = mask.nonzero().squeeze(1)
        self._fields[name][ids.numpy()] = values[ids].numpy()

    def write_terrain(self, mask: torch.Tensor, tile: torch.Tensor) -> None:
        """Show a tile in the masked worlds."""
        rows = mask.nonzero().squeeze(1).numpy()
        if len(rows):
            self._tile[rows] = tile.numpy()[rows]
            self._show_tiles(rows)
            self._batch.set_const(rows)  # renews the bounding volumes, or boxes collide wrongly

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return all that the next steps depend on."""
        state = {f"field/{name}": torch.tensor(x) for name, x in self._fields.items()}
        return state | {"state": torch.tensor(self._batch.state), "tile": torch.tensor(self._tile)}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Go on from a saved state."""
        self._tile[:] = state["tile"].numpy()
        if self._terrain_tables:
            self._show_tiles(slice(None))
            self._batch.set_const()
        for name, field in self._fields.items():  # last: set_const would round them otherwise
            field[:] = state[f"field/{name}"].numpy()
        self._batch.state[:] = state["state"].numpy()
        self._read_state()
