"""Unitree Go1 by the messages of unitree_legged_sdk 3.8: UDP, little endian, packed.

Sources: comm.h and joystick.h of unitreerobotics/unitree_legged_sdk. How its library packs the
structs was found with its Python wheel, unitree-legged-sdk 3.8.20231105, and a test compares them.
Joint order, signs, frames and the quaternion's order are those of robots/go1/robot.yaml.
"""

from __future__ import annotations

import socket
import zlib

import numpy as np

from kiras_rl.deploy.runtime.driver import Link, LinkError
from kiras_rl.deploy.runtime.hands import remote_emergency
from kiras_rl.deploy.runtime.messages import NANO, Flag, Mode

ROBOT = "192.168.123.10:8007"
LOCAL_PORT = 8090  # of the examples in the SDK
LOW_LEVEL = 0xFF
SERVO = 0x0A  # mode of a motor: position, speed and torque
NO_POSITION, NO_SPEED = 2.146e9, 16000.0  # PosStopF, VelStopF: leave that term out
MOTORS = 20  # in a message; Go1 has the first 12
SILENT = 0.1  # s without a state, after which states are missing and not late

_HEAD = [
    ("head", "u1", 2),  # FE EF
    ("level", "u1"),
    ("frame", "u1"),
    ("serial", "<u4", 2),
    ("version", "<u4", 2),
    ("bandwidth", "<u2"),
]
COMMAND = np.dtype(
    [
        *_HEAD,
        (
            "motor",
            [
                ("mode", "u1"),
                ("q", "<f4"),  # rad
                ("dq", "<f4"),  # rad/s
                ("tau", "<i2"),  # N m / 256
                ("kp", "<i2"),  # N m/rad / 32
                ("kd", "<i2"),  # N m s/rad / 16
                ("reserve", "u1", 12),
            ],
            MOTORS,
        ),
        ("bms", "u1", 4),
        ("remote", "u1", 40),
        ("reserve", "<u4"),
        ("crc", "<u4"),
    ]
)
"""LowCmd on the wire, 614 bytes."""

STATE = np.dtype(
    [
        *_HEAD,
        (
            "imu",
            [
                ("quat", "<f4", 4),  # w x y z
                ("gyro", "<f4", 3),  # rad/s
                ("acc", "<f4", 3),  # m/s^2
                ("rpy", "<f4", 3),  # rad
                ("temperature", "i1"),
            ],
        ),
        (
            "motor",
            [
                ("mode", "u1"),
                ("q", "<f4"),  # rad
                ("dq", "<f4"),  # rad/s
                ("ddq", "<i2"),
                ("tau", "<i2"),  # N m / 256
                ("q_raw", "<f4"),
                ("dq_raw", "<f4"),
                ("ddq_raw", "<i2"),
                ("temperature", "i1"),  # degrees Celsius
                ("reserve", "u1", 8),
            ],
            MOTORS,
        ),
        ("bms_version", "u1", 2),
        ("bms_status", "u1"),
        ("charge", "u1"),  # percent
        ("bms_rest", "u1", 20),
        ("foot_force", "<i2", 4),
        ("foot_force_est", "<i2", 4),
        ("tick", "<u4"),  # grows from state to state
        ("remote", "u1", 40),
        ("reserve", "<u4"),
        ("crc", "<u4"),
    ]
)
"""LowState on the wire, 807 bytes."""

_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


def checksum(message: bytes) -> int:
    """Return the CRC of a message: polynomial 0x04C11DB7 over its whole words before the CRC.

    The first bit of a word is its highest, so that zlib's CRC, which begins with the lowest one, is
    given every byte reversed, and its result is turned round.
    """
    words = np.frombuffer(message, "<u4", (len(message) - 4) // 4).byteswap()
    crc = zlib.crc32(words.tobytes().translate(_REVERSED)) ^ 0xFFFFFFFF
    return int(f"{crc:032b}"[::-1], 2)


def seal(message: np.ndarray) -> bytes:
    """Return the bytes of a message, COMMAND or STATE of shape (), with its CRC."""
    message["crc"] = checksum(message.tobytes())
    return message.tobytes()


def encode(mode: Mode, order: np.ndarray, joints: int, damping: float) -> bytes:
    """Return the command that makes the motors do something.

    Args:
        mode: What they shall do.
        order: With targets and gains for Mode.SERVO and Mode.HOLD, shape ().
        joints: How many of the order's joints the robot has.
        damping: Of Mode.DAMP, N m s/rad.
    """
    command = np.zeros((), COMMAND)
    command["head"], command["level"] = (0xFE, 0xEF), LOW_LEVEL
    everyone = command["motor"]
    everyone["mode"], everyone["q"], everyone["dq"] = SERVO, NO_POSITION, NO_SPEED
    motor = everyone[:joints]
    if mode in (Mode.SERVO, Mode.HOLD):
        motor["q"], motor["dq"] = order["target"][:joints], 0.0
        motor["kp"] = 32 * order["kp"][:joints]  # cut off, as the SDK does
        motor["kd"] = 16 * order["kd"][:joints]
    elif mode == Mode.DAMP:
        motor["dq"], motor["kd"] = 0.0, round(16 * damping)
    return seal(command)


def decode(data: bytes) -> np.ndarray | None:
    """Return the STATE in a datagram, shape (), or None if it is damaged."""
    if len(data) != STATE.itemsize or data[:2] != b"\xfe\xef":
        return None
    state = np.frombuffer(data, STATE)[0]
    return state if state["crc"] == checksum(data) else None


class Go1(Link):
    """The robot at the other end of a UDP socket."""

    def __init__(
        self, address: str, joints: int, damping: float, local_port: int = LOCAL_PORT
    ) -> None:
        """Open the socket.

        Args:
            address: host:port of the robot's motor controller; empty for ROBOT.
            joints: How many joints the policy has.
            damping: Of Mode.DAMP, N m s/rad.
            local_port: Ours; 0 for any.

        Raises:
            LinkError: If the address makes no sense, or somebody else has the port.
        """
        host, _, port = (address or ROBOT).partition(":")
        self._joints, self._damping = joints, damping
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind(("", local_port))
        except OSError:
            self._socket.close()
            raise LinkError(
                f"UDP port {local_port} is taken: another program commands the robot; end it first"
            ) from None
        try:
            self._socket.connect((host, int(port)))  # from now on nobody else is heard
        except (OSError, ValueError) as error:
            self._socket.close()
            raise LinkError(f"--address {address}: {error}; host:port is expected") from None
        self._tick: int | None = None
        self._heard = 0

    def receive(self, reading: np.ndarray, now: int) -> bool:
        """See Link."""
        newest, torn = None, False
        for data in self._datagrams():
            state = decode(data)
            torn |= state is None
            if state is not None and self._is_newer(int(state["tick"])):
                newest, self._tick = state, int(state["tick"])
        if newest is None:
            late = self._tick is not None and now - self._heard > SILENT * NANO
            reading["flags"] = (int(reading["flags"]) & ~Flag.TORN) | (Flag.TORN * (torn or late))
            return False
        self._heard = now
        self._fill(reading, newest, torn)
        return True

    def send(self, mode: Mode, order: np.ndarray, now: int) -> None:
        """See Link."""
        try:
            self._socket.send(encode(mode, order, self._joints, self._damping))
        except OSError:  # the cable is out: no state comes either, and that is found
            return

    def close(self) -> None:
        """Let go of the socket."""
        self._socket.close()

    def _datagrams(self) -> list[bytes]:
        """Return what has come since the last call, oldest first."""
        found = []
        try:
            while True:
                found.append(self._socket.recv(2048))
        except OSError:  # nothing more, or nobody at the other end
            return found

    def _is_newer(self, tick: int) -> bool:
        return self._tick is None or 0 < (tick - self._tick) % 2**32 < 2**31

    def _fill(self, reading: np.ndarray, state: np.ndarray, torn: bool) -> None:
        n = self._joints
        motor, imu = state["motor"][:n], state["imu"]
        reading["joint_pos"][:n], reading["joint_vel"][:n] = motor["q"], motor["dq"]
        reading["torque"][:n] = motor["tau"] / 256
        reading["temperature"][:n] = motor["temperature"]
        for name in ("quat", "gyro", "acc"):
            reading[name] = imu[name]
        reading["battery"] = state["charge"] / 100
        reading["remote"] = state["remote"]
        flags = Flag.CALIBRATED | (Flag.TORN if torn else 0)
        if state["level"] != LOW_LEVEL:
            flags |= Flag.OTHER_CONTROLLER
        if remote_emergency(state["remote"].tobytes()):
            flags |= Flag.EMERGENCY
        reading["flags"] = flags
