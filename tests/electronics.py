"""The other end of the robots' wires: Go1's controller and Solo-8's master board, on a plant.

They know the maker's documents, and nothing of our drivers but the layout of the messages, which
tests compare with the makers' own libraries.
"""

from __future__ import annotations

import socket
from collections.abc import Callable

import numpy as np
from rig import Rig

from kiras_rl.deploy.runtime import go1, solo8
from kiras_rl.deploy.runtime.messages import NANO, Mode, Request, State, make_reading
from kiras_rl.deploy.runtime.simulated import Plant

MS = NANO // 1000
Spoil = Callable[[bytes, int], list[bytes]]  # a message and the time in ns -> what arrives of it


def whole(message: bytes, now: int) -> list[bytes]:
    return [message]


def drain(wire: socket.socket) -> None:
    try:
        while True:
            wire.recv(4096)
    except OSError:
        return


class Go1Electronics:
    """The motor controller of a Go1, on a UDP socket of 127.0.0.1.

    Attributes:
        port: Where it listens.
        level: LOW_LEVEL, or what it is in while the maker's own controller walks.
        remote: The 40 bytes of its remote.
        plugged: Whether the cable is in.
        spoil: What the way to the driver does to messages.
    """

    def __init__(self, plant: Plant, rate: float = 500.0) -> None:
        self._plant, self._steps = plant, round(1000 / rate)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self.port = self._socket.getsockname()[1]
        self.level, self.remote, self.plugged = go1.LOW_LEVEL, bytes(40), True
        self.spoil: Spoil = whole
        self._peer = None
        self._action = (Mode.OFF, *np.zeros((3, 12)))
        self._reading = make_reading()
        self._tick = 0

    def step(self, now: int) -> None:
        self._receive()
        for _ in range(self._steps):
            self._plant.step(self._action)
        self._tick += self._steps  # ms
        if self._peer is not None and self.plugged:
            for message in self.spoil(self._state(), now):
                self._socket.sendto(message, self._peer)

    def drain(self) -> None:
        drain(self._socket)

    def close(self) -> None:
        self._socket.close()

    def _receive(self) -> None:
        try:
            while True:
                data, peer = self._socket.recvfrom(2048)
                self._peer = peer
                if self.plugged:
                    self._obey(data)
        except BlockingIOError:
            return

    def _obey(self, data: bytes) -> None:
        command = np.frombuffer(data, go1.COMMAND)[0]
        assert command["crc"] == go1.checksum(data)
        motor = command["motor"][:12]
        assert (motor["mode"] == go1.SERVO).all()
        target = np.where(motor["q"] == np.float32(go1.NO_POSITION), 0.0, motor["q"])
        self._action = (Mode.SERVO, target, motor["kp"] / 32, motor["kd"] / 16)

    def _state(self) -> bytes:
        reading, state = self._reading, np.zeros((), go1.STATE)
        self._plant.measure(reading)
        state["head"], state["level"], state["tick"] = (0xFE, 0xEF), self.level, self._tick
        motor = state["motor"][:12]
        motor["q"], motor["dq"] = reading["joint_pos"], reading["joint_vel"]
        motor["tau"] = np.rint(256 * reading["torque"])
        motor["temperature"], state["charge"] = 40, 80
        for name in ("quat", "gyro", "acc"):
            state["imu"][name] = reading[name]
        state["remote"] = np.frombuffer(self.remote, np.uint8)
        return go1.seal(state)


class MasterBoard:
    """The master board of a Solo-8 and its motor boards, on one end of a socket pair.

    Attributes:
        wire: The other end, for the driver.
        zero: Angle of each joint where its encoder's index is, rad.
        plugged: Whether the cable is in.
        errors: The error code in each board's status.
        spoil: What the way to the driver does to messages.
    """

    TIMEOUT = 20 * MS  # CONFIG_WIFI_ETH_TIMEOUT_CONTROL of the firmware

    def __init__(self, plant: Plant, seed: int = 0, protocol: int = 3) -> None:
        self._plant, self._protocol = plant, protocol
        self._own, self.wire = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._own.setblocking(False)
        random = np.random.default_rng(seed)
        start = np.array(plant.data.qpos[7:])
        # Within half a turn of the motor, on the side to which a folded leg can go.
        self.zero = start - np.sign(start) * random.uniform(0.05, 0.3, 8)
        self._boot = start.copy()  # encoders count from where the robot was switched on
        self._seen = np.zeros(8, bool)
        self._ready = np.zeros(8)
        self._command: np.ndarray | None = None
        self._session, self._heard, self._count = 0, 0, 0
        self.state, self.plugged, self.errors = "waiting", True, np.zeros(6, np.uint16)
        self._reading = make_reading()
        self._before = start.copy()
        self.spoil: Spoil = whole

    def step(self, now: int) -> None:
        if self.plugged:
            self._receive(now)
        if self.state == "active" and now - self._heard > self.TIMEOUT:
            self.state, self._command = "error", None
        self._move(now)
        if not self.plugged:
            return
        if self.state == "acknowledging":
            self._answer(self._session)
        else:
            self._count += 1
            for message in self.spoil(self._sensor().tobytes(), now):
                self._send(message)

    def drain(self) -> None:
        drain(self._own)
        drain(self.wire)

    def close(self) -> None:
        self._own.close()
        self.wire.close()

    def _send(self, payload: bytes) -> None:
        try:
            self._own.send(solo8.frame(payload))
        except (BlockingIOError, ConnectionError):
            return

    def _answer(self, session: int) -> None:
        if self._protocol == 4:
            self._send(solo8.ANSWER_4.pack(4, session, 0b1111))
        else:
            self._send(solo8.ANSWER.pack(session, 0b1111))

    def _receive(self, now: int) -> None:
        try:
            while True:
                payload = solo8.payload_of(self._own.recv(2048))
                if len(payload) == solo8.HELLO.size and self.state in ("waiting", "error"):
                    protocol, session = solo8.HELLO.unpack(payload)
                    if protocol == self._protocol:
                        self._session, self.state = session, "acknowledging"
                    elif self._protocol == 4:
                        self._answer(session)  # to say which protocol it speaks
                elif len(payload) == solo8.COMMAND.itemsize and self.state != "waiting":
                    command = np.frombuffer(payload, solo8.COMMAND)[0]
                    if command["session"] == self._session and self.state != "error":
                        self._command, self._heard, self.state = command, now, "active"
        except BlockingIOError:
            return

    def _move(self, now: int) -> None:
        """Let the motor boards control their motors for a millisecond."""
        command = self._command
        on = command is not None and now - self._heard <= solo8.TIMEOUT * MS
        on = on and bool(command["board"]["mode"][:4].all() and command["board"]["mode"][0] >> 15)
        pos = np.array(self._plant.data.qpos[7:])
        crossed = (self._before - self.zero) * (pos - self.zero) <= 0
        self._seen |= crossed & (self._ready >= 500)
        self._before = pos
        self._ready = np.where(on, self._ready + 1, 0)
        zeros = np.zeros(8)
        if not on or (self._ready < 500).any():
            self._plant.step((Mode.OFF, zeros, zeros, zeros))
            return
        boards, per_amp = command["board"][:4], solo8.GEAR * solo8.TORQUE_CONSTANT

        def joints(name: str) -> np.ndarray:
            return boards[name].reshape(-1)[solo8.MOTORS].astype(float)

        target = solo8.SIGNS * joints("position") / 2**24 * 2 * np.pi / solo8.GEAR + self._origin()
        kp = joints("kp") / 2**11 / (2 * np.pi) * solo8.GEAR * per_amp
        kd = joints("kd") / 2**10 / solo8._KRPM * solo8.GEAR * per_amp
        self._plant.step((Mode.SERVO, target, kp, kd))

    def _origin(self) -> np.ndarray:
        """Return the angles of the joints where the boards count zero."""
        bits = self._command["board"]["mode"][:4] if self._command is not None else np.zeros(4)
        compensates = bool(np.asarray(bits, int)[0] & solo8.INDEX_1)
        return np.where(self._seen & compensates, self.zero, self._boot)

    def _sensor(self) -> np.ndarray:
        kind = solo8.SENSOR_4 if self._protocol == 4 else solo8.SENSOR
        reading, sensor = self._reading, np.zeros((), kind)
        self._plant.measure(reading)
        sensor["session"], sensor["index"] = self._session, self._count % 2**16
        boards = sensor["board"][:4]
        angle = reading["joint_pos"][:8] - self._origin()

        def put(name: str, values: np.ndarray) -> None:
            motors = np.empty(8)
            motors[solo8.MOTORS] = solo8.SIGNS * values
            boards[name] = np.rint(motors).reshape(-1, 2)

        put("position", angle * solo8.GEAR / (2 * np.pi) * 2**24)
        put("velocity", reading["joint_vel"][:8] * solo8.GEAR / solo8._KRPM * 2**11)
        put("current", reading["torque"][:8] / solo8.GEAR / solo8.TORQUE_CONSTANT * 2**10)
        status = np.zeros(8, int)
        status[solo8.MOTORS] = (self._ready >= 500) * 1 + self._seen * 2
        status = status.reshape(-1, 2)
        bits = ((status & 1) * solo8.READY + (status >> 1) * solo8.INDEX).sum(axis=1)
        boards["status"] = bits | self.errors[:4]
        sensor["gyro"] = np.rint(reading["gyro"] * 2**11)
        sensor["acc"] = np.rint(reading["acc"] / 9.80665 * 2**11)
        sensor["attitude"] = np.rint(np.array(_euler(reading["quat"])) * 2**13)
        return sensor


def go1_world(rig: Rig) -> go1.Go1:
    """Put a Go1's electronics and our driver's link to it into a rig."""
    rig.electronics = Go1Electronics(rig.plant)
    return go1.Go1(f"127.0.0.1:{rig.electronics.port}", 12, rig.profile.damping, 0)


def solo8_world(rig: Rig, protocol: int = 3) -> solo8.Solo8:
    """Put a Solo-8's electronics and our driver's link to it into a rig."""
    rig.electronics = MasterBoard(rig.plant, protocol=protocol)
    torque = np.array(rig.policy.metadata.torque_limit)
    return solo8.Solo8(rig.electronics.wire, rig.electronics.zero, torque, rig.profile.damping)


WORLDS = {"go1": go1_world, "solo8": solo8_world}


def calibrate_hung_up(rig: Rig) -> None:
    """Let a Solo-8 search its zeros with its legs in the air, and put it down."""
    rig.plant.data.qpos[2] += 0.4
    rig.plant.model.opt.gravity[2] = 0.0
    rig.run(0.8)
    rig.press(Request.ACKNOWLEDGE)
    rig.run_until(State.CALIBRATED)
    rig.plant.data.qpos[2] -= 0.36
    rig.plant.data.qvel[:] = 0.0
    rig.plant.model.opt.gravity[2] = -9.81


def _euler(quat: np.ndarray) -> tuple[float, float, float]:
    w, x, y, z = (float(value) for value in quat)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - x * z), -1, 1))
    return roll, pitch, np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
