"""The last minute of readings and orders, in memory that outlives the processes; a dataset on disk.

Letters: N rows of the ring, M frames, J joints.
"""

from __future__ import annotations

import json
import mmap
import os
from pathlib import Path
from typing import Any

import numpy as np

from kiras_rl.deploy.metadata import PolicyMetadata
from kiras_rl.deploy.runtime.messages import NANO, ORDER, READING

LENGTH = 60.0  # s
ROW = np.dtype([("reading", READING), ("order", ORDER)])
_HEAD = np.dtype([("rows", "<u8"), ("count", "<u8")])  # N, and rows written since the start

_XYZ = ("x", "y", "z")


class Ring:
    """A ring of rows in a file that lies in memory."""

    def __init__(self, path: Path, rows: int | None = None) -> None:
        """Make a ring, or open one.

        Args:
            path: The file.
            rows: N for a new, empty ring; None to read one that is there.

        Raises:
            FileNotFoundError: If there is none to read.
        """
        flags = os.O_RDWR | (os.O_CREAT if rows else 0)
        with open(os.open(path, flags, 0o600), "r+b") as file:
            if rows:
                file.truncate(0)
                file.truncate(_HEAD.itemsize + rows * ROW.itemsize)
            memory = mmap.mmap(file.fileno(), 0)
        self._head = np.frombuffer(memory, _HEAD, count=1)
        if rows:
            self._head["rows"] = rows
        self._rows = np.frombuffer(
            memory, ROW, count=int(self._head["rows"][0]), offset=_HEAD.itemsize
        )
        self._count = int(self._head["count"][0])

    def append(self, reading: np.ndarray, order: np.ndarray) -> None:
        """Write a row in the place of the oldest one."""
        row = self._rows[self._count % len(self._rows)]
        row["reading"], row["order"] = reading, order
        self._count += 1
        self._head["count"] = self._count  # last: a row counts when it is whole

    def rows(self) -> np.ndarray:
        """Return the rows that were written, oldest first, (M,)."""
        count, size = int(self._head["count"][0]), len(self._rows)
        if count <= size:
            return self._rows[:count].copy()
        return np.roll(self._rows, -(count % size))


def save(rows: np.ndarray, metadata: PolicyMetadata, path: Path, events: list[str]) -> None:
    """Write rows as a dataset, which `kiras_rl.dataset.load_dataset` reads (docs/datasets.md).

    A frame is a measurement, and the order that the motors followed then. Moments at which no
    measurement came, which the driver records too, are left out: `seq` tells where.

    Args:
        rows: Of `Ring.rows`, (M,).
        metadata: Of the policy that ran.
        path: The folder; it must not hold a dataset yet.
        events: Lines of the log.

    Raises:
        OSError: If it cannot be written.
        ValueError: If there are no rows.
    """
    fresh = rows[np.flatnonzero(np.diff(rows["reading"]["seq"], prepend=0))]
    if not len(fresh):
        raise ValueError("the black box is empty: no reading came")
    values, features = _features(fresh, metadata)
    count = len(fresh)
    times = fresh["reading"]["time"]
    last = np.arange(count) == count - 1
    path.mkdir(parents=True)
    arrays: dict[str, Any] = {
        "episode": np.zeros(count, np.int64),
        "skill": fresh["order"]["skill"].astype(np.int64),
        "done": last,
        "fallen": np.zeros(count, bool),
        **values,
    }
    np.savez_compressed(path / "dataset.npz", **arrays)
    header = {
        "format": 1,
        "robot": metadata.robot,
        "rate": round((count - 1) * NANO / max(int(times[-1] - times[0]), 1), 3),
        "skills": metadata.skills,
        "episodes": 1,
        "frames": count,
        "features": features,
        "provenance": {"made_by": "kiras-robot", "events": events},
    }
    text = json.dumps(header, indent=1) + "\n"
    (path / "dataset.json").write_text(text, encoding="utf-8")  # last: then it is a dataset


def _features(
    rows: np.ndarray, metadata: PolicyMetadata
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return values (M, K) and descriptions, names and units as in kiras-collect's datasets."""
    joints, reading, order = metadata.joint_names, rows["reading"], rows["order"]
    each = len(joints)
    time = (reading["time"] - reading["time"][0])[:, None] / NANO
    table = {
        "time": (time, ("time",), "s"),
        "seq": (reading["seq"][:, None], ("seq",), "1"),
        "base_quat_w": (reading["quat"], ("w", *_XYZ), "1"),
        "projected_gravity": (_gravity(reading["quat"]), _XYZ, "1"),
        "base_ang_vel_b": (reading["gyro"], _XYZ, "rad/s"),
        "base_lin_acc_b": (reading["acc"], _XYZ, "m/s^2"),
        "joint_pos": (reading["joint_pos"][:, :each], joints, "rad"),
        "joint_vel": (reading["joint_vel"][:, :each], joints, "rad/s"),
        "joint_torque": (reading["torque"][:, :each], joints, "N m"),
        "motor_temperature": (reading["temperature"][:, :each], joints, "degC"),
        "battery": (reading["battery"][:, None], ("battery",), "1"),
        "joint_target": (order["target"][:, :each], joints, "rad"),
        "joint_kp": (order["kp"][:, :each], joints, "N m/rad"),
        "joint_kd": (order["kd"][:, :each], joints, "N m s/rad"),
        "command": (order["command"], ("lin_vel_x", "lin_vel_y", "ang_vel_z"), "m/s, rad/s"),
        "state": (order["state"][:, None], ("state",), "1"),
        "mode": (reading["mode"][:, None], ("mode",), "1"),
        "flags": (reading["flags"][:, None], ("flags",), "1"),
    }
    values = {name: np.asarray(array, np.float32) for name, (array, _, _) in table.items()}
    values["seq"] = table["seq"][0].astype(np.int64)
    values["time"] = time  # a minute in float32 has steps of 4 microseconds
    units = {"command": ("m/s", "m/s", "rad/s")}
    features = {
        name: {"names": names, "units": units.get(name, (unit,) * len(names))}
        for name, (_, names, unit) in table.items()
    }
    return values, features


def _gravity(quat: np.ndarray) -> np.ndarray:
    """Return gravity's direction in the base frame of (M, 4) quaternions, (M, 3)."""
    w, x, y, z = quat.astype(np.float64).T
    return -np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
