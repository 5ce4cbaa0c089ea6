"""Solo-8 by the Ethernet frames of its master board, in protocols 3 and 4.

Sources: protocol.h, defines.h, ETHERNET_types.h and documentation/BLMC_uDriver_SPI_interface.md of
open-dynamic-robot-initiative/master-board 1.0, whose wheel speaks 3; for 4 main/defines.h and
masterboard_main.c of the later firmware (JonathanEh01/master-board at ee6db8f), which adds the
power board's numbers to a measurement, and its version to an answer. Motors and gear as in
odri_control_interface at dcc07e4 and solo8.cpp of open-dynamic-robot-initiative/solo at 0babe3d.

The PD controller runs on the motor boards, within a current that they saturate, so that no jitter
of this computer gets into it. Numbers on the wire are of the motor, before the gear.

Letters: J joints, 8.
"""

from __future__ import annotations

import json
import socket
import struct
from pathlib import Path

import numpy as np

from kiras_rl.deploy.runtime.driver import Link, LinkError
from kiras_rl.deploy.runtime.messages import NANO, Flag, Mode

PROTOCOLS = (3, 4)
ETHERTYPE = 0x88B5  # for local experiments
SOURCE = bytes.fromhex("a01d4812a0c5")  # the SDK's address; the board answers to everybody
EVERYBODY = b"\xff" * 6
BOARDS = 6  # in a message; Solo-8 has the first four, two motors each
TIMEOUT = 5  # ms without a command, after which a motor board switches itself off
GREETING = 1.0  # s until a board that does not answer is given up

GEAR = 9.0
TORQUE_CONSTANT = 0.025  # N m/A of the motor
MOTORS = np.array([0, 1, 3, 2, 5, 4, 6, 7])  # motor of each joint
SIGNS = np.array([-1, -1, 1, 1, -1, -1, 1, 1])  # of the motor's angle along the joint's

# Search of the encoders' index: every motor turns by a little more than half a turn to each side.
SEARCH_AMPLITUDE = 1.1 * np.pi / GEAR  # rad of the joint
SEARCH_PERIOD = 4.0  # s
SEARCH_GAINS = 3.0, 0.05  # N m/rad, N m s/rad

ENABLE, ENABLE_1, ENABLE_2, ROLLOVER, INDEX_1, INDEX_2 = (1 << bit for bit in range(15, 9, -1))
READY = np.array([1 << 13, 1 << 11])  # of a board's two motors, in its status
INDEX = np.array([1 << 10, 1 << 9])
ERROR = 0xF

COMMAND = np.dtype(
    [
        ("session", "<u2"),
        (
            "board",
            [
                ("mode", "<u2"),
                ("position", "<i4", 2),  # turns, Q24
                ("velocity", "<i2", 2),  # 1000 rpm, Q11
                ("current", "<i2", 2),  # A, Q10
                ("kp", "<u2", 2),  # A/turn, Q11
                ("kd", "<u2", 2),  # A/(1000 rpm), Q10
                ("saturation", "u1", 2),  # A, Q3
            ],
            BOARDS,
        ),
        ("index", "<u2"),
    ]
)
"""From the computer, 172 bytes."""

_MEASURED = [
    ("session", "<u2"),
    (
        "board",
        [
            ("status", "<u2"),
            ("timestamp", "<u2"),
            ("position", "<i4", 2),
            ("velocity", "<i2", 2),
            ("current", "<i2", 2),
            ("resistance", "<u2", 2),
            ("adc", "<u2", 2),
        ],
        BOARDS,
    ),
    ("acc", "<i2", 3),  # g, Q11
    ("gyro", "<i2", 3),  # rad/s, Q11
    ("attitude", "<i2", 3),  # roll, pitch, yaw, rad, Q13
    ("linear_acc", "<i2", 3),  # g, Q11, without gravity
]
_POWER = [
    ("bus", "<u2"),  # 3.125 mV
    ("shunt", "<i2"),  # 5 uV over 4 mOhm
    ("energy", "<f4"),  # the product of both, summed
]
_COUNTS = [("index", "<u2"), ("lost", "<u2"), ("last_command", "<u2")]  # lost: commands

SENSOR = np.dtype([*_MEASURED, *_COUNTS])
"""From a board of protocol 3, 200 bytes."""

SENSOR_4 = np.dtype([*_MEASURED, *_POWER, *_COUNTS])
"""From a board of protocol 4, 208 bytes."""

HELLO = struct.Struct("<HH")  # protocol, session
ANSWER = struct.Struct("<HB")  # session, boards that are connected, a bit each
ANSWER_4 = struct.Struct("<HHB")  # protocol, session, boards; also to a HELLO of another protocol

_TURN = 2 * np.pi
_KRPM = _TURN * 1000 / 60  # rad/s
_GRAVITY = 9.80665  # m/s^2


def frame(payload: bytes) -> bytes:
    """Return an Ethernet frame; the SDK never sends fewer than 64 bytes."""
    head = EVERYBODY + SOURCE + ETHERTYPE.to_bytes(2, "big") + struct.pack("<H", len(payload))
    return (head + payload).ljust(64, b"\0")


def payload_of(data: bytes) -> bytes:
    """Return what a frame carries; nothing if it is not one of ours."""
    if len(data) < 16 or data[12:14] != ETHERTYPE.to_bytes(2, "big"):
        return b""
    (length,) = struct.unpack_from("<H", data, 14)
    payload = data[16 : 16 + length]
    return payload if len(payload) == length else b""


def encode(
    targets: np.ndarray, kp: np.ndarray, kd: np.ndarray, torque: np.ndarray, mode: int
) -> np.ndarray:
    """Return the COMMAND, shape (), that makes the joints follow targets.

    Args:
        targets: Joint angles from the encoders' zeros, (J,), rad.
        kp: (J,), N m/rad.
        kd: (J,), N m s/rad.
        torque: Largest torque, (J,), N m.
        mode: Bits of every board.
    """
    command = np.zeros((), COMMAND)
    boards = command["board"][: len(MOTORS) // 2]
    boards["mode"] = mode
    per_amp = GEAR * TORQUE_CONSTANT
    _put(boards, "position", SIGNS * GEAR * targets / _TURN * 2**24, 2**31 - 1)
    _put(boards, "kp", kp / (GEAR * per_amp) * _TURN * 2**11, 2**15 - 1)
    _put(boards, "kd", kd / (GEAR * per_amp) * _KRPM * 2**10, 2**15 - 1)
    _put(boards, "saturation", torque / per_amp * 2**3, 2**8 - 1)
    return command


def _put(boards: np.ndarray, name: str, values: np.ndarray, largest: float) -> None:
    """Write a number of each joint, (J,), in the place of its motor; what is cut off is below 1."""
    by_motor = np.empty(len(MOTORS))
    by_motor[MOTORS] = np.clip(values, -largest, largest)
    boards[name] = np.trunc(by_motor).reshape(-1, 2)


def _get(boards: np.ndarray, name: str) -> np.ndarray:
    """Return a number of each joint, (J,), of its motor's angle along the joint's."""
    return SIGNS * boards[name][: len(MOTORS) // 2].reshape(-1)[MOTORS]


def open_socket(interface: str) -> socket.socket:
    """Return a socket that sends and receives frames on a network interface.

    Raises:
        LinkError: If there is none of this name, or the system refuses.
    """
    try:
        raw = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETHERTYPE))
        raw.bind((interface, ETHERTYPE))
    except PermissionError:
        raise LinkError("raw Ethernet needs root, or CAP_NET_RAW for this Python") from None
    except OSError as error:
        raise LinkError(
            f"--address {interface}: {error.strerror}; name the interface of the robot's cable "
            "(ip link)"
        ) from None
    return raw


def read_calibration(path: str) -> np.ndarray:
    """Read the angles of the joints at their encoders' index, (J,), rad: a JSON list.

    Raises:
        LinkError: If the file does not hold eight numbers.
    """
    if not path:
        raise LinkError("Solo-8 needs --calibration FILE: eight angles at the index, rad, as [..]")
    try:
        angles = np.array(json.loads(Path(path).read_text(encoding="utf-8")), np.float64)
    except (OSError, ValueError, TypeError) as error:
        raise LinkError(f"--calibration {path}: {error}") from None
    if angles.shape != (len(MOTORS),) or not np.isfinite(angles).all():
        raise LinkError(f"--calibration {path}: a list of {len(MOTORS)} numbers, rad, is expected")
    return angles


class Solo8(Link):
    """The master board at the other end of a socket that carries Ethernet frames."""

    def __init__(
        self, wire: socket.socket, offsets: np.ndarray, torque: np.ndarray, damping: float
    ) -> None:
        """Take over a socket.

        Args:
            wire: Of `open_socket`.
            offsets: Of `read_calibration`, (J,), rad.
            torque: Largest torque of each joint, (J,), N m.
            damping: Of Mode.DAMP, N m s/rad.
        """
        self._wire, self._offsets, self._torque = wire, offsets, torque
        self._damping = np.full(len(MOTORS), damping)
        self._wire.setblocking(False)
        self._session: int | None = None
        self._protocol: int | None = None  # that of the answer
        self._begun = self._count = 0
        self._calibrated = False
        self._index: int | None = None
        self._status = np.zeros(BOARDS, np.uint16)
        self._position = np.zeros(len(MOTORS))
        self._search: tuple[int, np.ndarray] | None = None
        self._found = np.zeros(len(MOTORS), bool)

    def receive(self, reading: np.ndarray, now: int) -> bool:
        """See Link."""
        newest = None
        for payload in self._payloads():
            self._hear_answer(payload)
            kind = SENSOR if self._protocol == 3 else SENSOR_4
            if self._protocol is not None and len(payload) == kind.itemsize:
                sensor = np.frombuffer(payload, kind)[0]
                if sensor["session"] == self._session and self._is_newer(sensor):
                    newest, self._index = sensor, int(sensor["index"])
        if newest is None:
            return False
        self._fill(reading, newest)
        return True

    def send(self, mode: Mode, order: np.ndarray, now: int) -> None:
        """See Link."""
        if self._protocol is None:
            self._greet(now)
            return
        command = self._command(mode, order, now)
        command["session"], command["index"] = self._session, self._count % 2**16
        self._count += 1
        self._put(command.tobytes())

    def close(self) -> None:
        """Let go of the socket; the motor boards switch themselves off within TIMEOUT."""
        self._wire.close()

    # --- the wire --------------------------------------------------------------------------------

    def _payloads(self) -> list[bytes]:
        found = []
        try:
            while True:
                found.append(payload_of(self._wire.recv(2048)))
        except OSError:  # nothing more, or the cable is out
            return found

    def _put(self, payload: bytes) -> None:
        try:
            self._wire.send(frame(payload))
        except OSError:  # the cable is out: no measurement comes either, and that is found
            return

    def _greet(self, now: int) -> None:
        """Ask the board to begin a session, in each protocol by turns.

        A board refuses the other one, in protocol 4 by an answer, so that each has a session
        number of its own, one that no session before has had.
        """
        if self._session is None:
            self._session, self._begun = 1 + (now // 1_000_000) % 65534, now
        if now - self._begun > GREETING * NANO:
            known = " or ".join(str(protocol) for protocol in PROTOCOLS)
            raise LinkError(
                f"the master board does not answer on this interface in protocol {known}: is it "
                "on, and is the cable in?"
            )
        place = self._count % len(PROTOCOLS)
        self._put(HELLO.pack(PROTOCOLS[place], self._session + place))
        self._count += 1

    def _hear_answer(self, payload: bytes) -> None:
        """Learn which protocol the board speaks, and go on in its session."""
        if self._session is None or self._protocol is not None:
            return
        if len(payload) == ANSWER.size and ANSWER.unpack(payload)[0] == self._session:
            self._protocol = 3
        elif payload[:4] == HELLO.pack(4, self._session + 1) and len(payload) == ANSWER_4.size:
            self._protocol, self._session = 4, self._session + 1

    def _is_newer(self, sensor: np.ndarray) -> bool:
        return self._index is None or 0 < (int(sensor["index"]) - self._index) % 2**16 < 2**15

    # --- the joints ------------------------------------------------------------------------------

    def _fill(self, reading: np.ndarray, sensor: np.ndarray) -> None:
        boards, n = sensor["board"], len(MOTORS)
        self._status = boards["status"][: n // 2]
        self._position = _get(boards, "position") / 2**24 * _TURN / GEAR
        offsets = np.where(self._calibrated, self._offsets, 0.0)
        reading["joint_pos"][:n] = self._position + offsets
        reading["joint_vel"][:n] = _get(boards, "velocity") / 2**11 * _KRPM / GEAR
        reading["torque"][:n] = _get(boards, "current") / 2**10 * GEAR * TORQUE_CONSTANT
        reading["gyro"] = sensor["gyro"] / 2**11
        reading["acc"] = sensor["acc"] / 2**11 * _GRAVITY
        reading["quat"] = _quat(*(sensor["attitude"] / 2**13))
        flags = Flag.CALIBRATED if self._calibrated else Flag(0)
        if (self._status & ERROR).any():
            flags |= Flag.MOTOR_ERROR
        reading["flags"] = flags

    def _bits(self, bits: np.ndarray) -> np.ndarray:
        """Tell which joints' motors have a bit of their board's status set, (J,)."""
        return ((self._status[:, None] & bits) != 0).reshape(-1)[MOTORS]

    def _command(self, mode: Mode, order: np.ndarray, now: int) -> np.ndarray:
        zero = np.zeros(len(MOTORS))
        if mode == Mode.OFF:
            return encode(zero, zero, zero, zero, TIMEOUT)
        bits = ENABLE | ENABLE_1 | ENABLE_2 | ROLLOVER | TIMEOUT
        if mode == Mode.CALIBRATE and not self._calibrated:
            return self._calibrate(bits, now)
        bits |= INDEX_1 | INDEX_2 if self._calibrated else 0
        if mode == Mode.DAMP or not self._calibrated:
            return encode(zero, zero, self._damping, self._torque, bits)
        n = len(MOTORS)
        gains = order["kp"][:n], order["kd"][:n]
        return encode(order["target"][:n] - self._offsets, *gains, self._torque, bits)

    def _calibrate(self, bits: int, now: int) -> np.ndarray:
        """Turn the motors until all have seen their index, then let the boards count from there."""
        zero = np.zeros(len(MOTORS))
        if not self._bits(READY).all():  # the rotors align themselves: a second, without load
            return encode(zero, zero, zero, self._torque, bits)
        if self._search is None:
            self._search = now, self._position.copy()
        begun, start = self._search
        self._found |= self._bits(INDEX)
        if self._found.all():
            # The boards' angles jump with these bits; the readings after it are of the new zero.
            self._calibrated = True
            return encode(zero, zero, self._damping, self._torque, bits | INDEX_1 | INDEX_2)
        phase = _TURN * (now - begun) / NANO / SEARCH_PERIOD
        goal = start + np.where(self._found, 0.0, SEARCH_AMPLITUDE * np.sin(phase))
        kp, kd = (np.full(len(MOTORS), gain) for gain in SEARCH_GAINS)
        return encode(goal, kp, kd, self._torque, bits)


def _quat(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Return the orientation of z-y-x Euler angles, rad, as w x y z. (4,)."""
    (cr, cp, cy), (sr, sp, sy) = (f(np.array([roll, pitch, yaw]) / 2) for f in (np.cos, np.sin))
    return np.array(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )
