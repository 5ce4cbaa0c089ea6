"""Both robots' messages: bytes of our own writing, and whole loops through real sockets."""

from __future__ import annotations

import socket
import struct

import numpy as np
import pytest
from electronics import WORLDS, calibrate_hung_up, solo8_world
from rig import Rig

from kiras_rl.deploy.runtime import go1, solo8
from kiras_rl.deploy.runtime.driver import LinkError
from kiras_rl.deploy.runtime.messages import ORDER, Flag, Mode, Request, State, make_reading


@pytest.fixture
def order():
    made = np.zeros((), ORDER)
    made["target"], made["kp"], made["kd"] = np.arange(12) / 10 - 0.5, 35.0, 0.5
    return made


# --- Go1 -----------------------------------------------------------------------------------------


def test_go1_s_messages_have_the_maker_s_sizes():
    assert (go1.COMMAND.itemsize, go1.STATE.itemsize) == (614, 807)


def test_a_command_to_go1_byte_for_byte(order):
    data = go1.encode(Mode.SERVO, order, 12, 5.0)
    head = bytes.fromhex("feefff") + bytes(19)
    # mode 0A, q, dq 0, tau 0, kp 35 * 32 = 1120, kd 0.5 * 16 = 8, twelve bytes reserved
    motors = [struct.pack("<Bffhhh12x", 10, q, 0.0, 0, 1120, 8) for q in order["target"]]
    unused = struct.pack("<Bffhhh12x", 10, 2.146e9, 16000.0, 0, 0, 0)
    body = head + b"".join(motors) + 8 * unused + bytes(48)
    assert data[:-4] == body
    assert int.from_bytes(data[-4:], "little") == slow_crc(body[:608])


def slow_crc(data):
    """CRC-32 with 0x04C11DB7 from FFFFFFFF, a bit at a time, over little-endian words."""
    crc = 0xFFFFFFFF
    for (word,) in struct.iter_unpack("<I", data):
        crc ^= word
        for _ in range(32):
            crc = ((crc << 1) ^ (0x04C11DB7 if crc >> 31 else 0)) & 0xFFFFFFFF
    return crc


def test_damping_and_off_leave_out_the_position(order):
    damp = np.frombuffer(go1.encode(Mode.DAMP, order, 12, 5.0), go1.COMMAND)[0]["motor"][0]
    assert (damp["kp"], damp["kd"], damp["dq"]) == (0, 80, 0.0)  # 5 N m s/rad in sixteenths
    off = np.frombuffer(go1.encode(Mode.OFF, order, 12, 5.0), go1.COMMAND)[0]["motor"][0]
    assert (off["q"], off["dq"], off["kp"], off["kd"]) == (np.float32(2.146e9), 16000.0, 0, 0)


def test_a_damaged_state_is_not_read():
    state = np.zeros((), go1.STATE)
    state["head"], state["level"] = (0xFE, 0xEF), 0xFF
    data = bytearray(go1.seal(state))
    assert go1.decode(bytes(data)) is not None
    data[100] ^= 4
    assert go1.decode(bytes(data)) is None
    assert go1.decode(bytes(data[:-1])) is None


@pytest.fixture
def go1_rig(tmp_path):
    rig = Rig("go1", tmp_path, world=WORLDS["go1"])
    yield rig
    rig.link.close()
    rig.electronics.close()


def test_go1_walks_through_its_wire_and_lies_down(go1_rig):
    go1_rig.walk("walk", (0.3, 0.0, 0.0))
    go1_rig.run(2.5)
    assert go1_rig.plant.data.qpos[0] > 0.2
    go1_rig.press(Request.LIE)
    go1_rig.run_until(State.LYING)
    assert go1_rig.runtime.fault == ""


def test_a_cable_that_is_pulled_is_damped_within_two_periods_and_named(go1_rig):
    go1_rig.walk()
    go1_rig.run(0.5)
    go1_rig.electronics.plugged = False
    go1_rig.run(0.07)  # two periods of 20 ms, the tick in which it is seen, and its own
    assert go1_rig.driver.mode == Mode.DAMP
    assert go1_rig.runtime.fault == "stale"


def test_the_maker_s_own_controller_keeps_the_motors_off(go1_rig):
    go1_rig.electronics.level = 0xEE
    go1_rig.run(0.8)
    go1_rig.press(Request.ACKNOWLEDGE)
    go1_rig.run(1.0)
    assert go1_rig.runtime.state == State.CALIBRATED
    assert "not ready: another controller commands the motors" in go1_rig.log


def test_button_b_of_the_remote_damps(go1_rig):
    go1_rig.walk()
    go1_rig.electronics.remote = struct.pack("<2xH36x", 1 << 9)
    go1_rig.run(0.03)
    assert go1_rig.driver.mode == Mode.DAMP
    assert go1_rig.runtime.fault == "emergency"


def test_a_port_that_is_taken_is_one_line():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("", 0))
        port = other.getsockname()[1]
        with pytest.raises(LinkError, match=f"UDP port {port} is taken: another program"):
            go1.Go1("127.0.0.1:9", 12, 5.0, port)


# --- Solo-8 --------------------------------------------------------------------------------------


def test_solo8_s_messages_have_the_maker_s_sizes():
    assert (solo8.COMMAND.itemsize, solo8.SENSOR.itemsize) == (172, 200)
    assert (solo8.HELLO.size, solo8.ANSWER.size) == (4, 3)
    assert (solo8.SENSOR_4.itemsize, solo8.ANSWER_4.size) == (208, 5)


def test_a_command_to_solo8_byte_for_byte():
    targets = np.array([0.1, -0.2, 0.3, -0.4, 0.5, -0.6, 0.7, -0.8])
    full = np.full(8, 1.0)
    command = solo8.encode(targets, 5.0 * full, 0.1 * full, 1.8 * full, 0xF005)
    command["session"], command["index"] = 0x1234, 7
    turns = 9 / (2 * np.pi) * 2**24
    # Motors 2 and 3, 4 and 5 are crossed; the left legs' motors turn the other way.
    angles = [(-0.1, 0.2), (-0.4, 0.3), (0.6, -0.5), (0.7, -0.8)]
    # 5 N m/rad: 15.51 A/turn in 1/2048; 0.1 N m s/rad: 5.171 A/krpm in 1/1024; 8 A in 1/8
    boards = [
        struct.pack("<Hii4hHHHHBB", 0xF005, int(a * turns), int(b * turns), 0, 0, 0, 0,
                    31772, 31772, 5295, 5295, 64, 64)
        for a, b in angles
    ]  # fmt: skip
    assert command.tobytes() == b"\x34\x12" + b"".join(boards) + bytes(56) + b"\x07\x00"


def test_a_frame_is_what_the_sdk_sends():
    data = solo8.frame(solo8.HELLO.pack(3, 0x1234))
    assert data[:20].hex() == "ffffffffffff" + "a01d4812a0c5" + "88b5" + "0400" + "03003412"
    assert len(data) == 64
    assert solo8.payload_of(data) == solo8.HELLO.pack(3, 0x1234)
    assert solo8.payload_of(data[:18]) == b""
    assert solo8.payload_of(data[:12] + b"\x08\x00" + data[14:]) == b""


@pytest.fixture
def solo8_rig(tmp_path):
    rig = Rig("solo8", tmp_path, world=WORLDS["solo8"])
    calibrate_hung_up(rig)
    yield rig
    rig.electronics.close()


def test_solo8_finds_its_zeros_rises_and_walks_through_its_wire(solo8_rig):
    solo8_rig.walk("walk", (0.3, 0.0, 0.0))
    assert solo8_rig.electronics.state == "active"
    reading = solo8_rig.channel.readings.get()
    assert reading["joint_pos"][:8] == pytest.approx(solo8_rig.plant.data.qpos[7:], abs=0.15)
    solo8_rig.run(2.5)
    assert solo8_rig.plant.data.qpos[0] > 0.2
    solo8_rig.press(Request.LIE)
    solo8_rig.run_until(State.LYING)
    assert solo8_rig.runtime.fault == ""


def test_an_error_of_a_motor_board_is_named(solo8_rig):
    solo8_rig.walk()
    solo8_rig.electronics.errors[1] = 1
    solo8_rig.run(0.03)
    assert solo8_rig.driver.mode == Mode.DAMP
    assert solo8_rig.runtime.fault == "motor"


def test_a_board_that_does_not_answer_is_one_line(order):
    own, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with own, other:
        link = solo8.Solo8(own, np.zeros(8), np.ones(8), 0.2)
        link.send(Mode.OFF, order, 10**9)
        assert solo8.payload_of(other.recv(2048)) == solo8.HELLO.pack(3, 1001)
        with pytest.raises(LinkError, match="does not answer on this interface in protocol 3"):
            link.send(Mode.OFF, order, 3 * 10**9)


ANSWERS = {3: (1001, solo8.ANSWER.pack(1001, 15)), 4: (1002, solo8.ANSWER_4.pack(4, 1002, 15))}
"""Session and answer of a board, by its protocol, to somebody who greets it at 1 s."""
KINDS = {3: solo8.SENSOR, 4: solo8.SENSOR_4}


@pytest.mark.parametrize("protocol", [3, 4])
def test_sensors_that_are_older_or_of_another_session_do_not_count(order, protocol):
    session, answer = ANSWERS[protocol]
    own, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with own, other:
        link = solo8.Solo8(own, np.zeros(8), np.ones(8), 0.2)
        reading = make_reading()
        link.send(Mode.OFF, order, 10**9)
        other.send(solo8.frame(answer))
        assert not link.receive(reading, 10**9)

        def arrives(session, index, kind=KINDS[protocol]):
            sensor = np.zeros((), kind)
            sensor["session"], sensor["index"] = session, index
            sensor["acc"] = 0, 0, 2048
            other.send(solo8.frame(sensor.tobytes()))
            return link.receive(reading, 10**9)

        assert arrives(session, 65535)
        assert reading["acc"] == pytest.approx([0.0, 0.0, 9.80665])
        assert not arrives(session, 65535)
        assert not arrives(session, 65500)
        assert not arrives(session + 1, 0)
        assert not arrives(session, 0, KINDS[7 - protocol])
        assert arrives(session, 0)


def test_a_measurement_in_protocol_4_byte_for_byte(order):
    own, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    motors = struct.pack("<HHii4h4H", 1 << 13, 0, 2**24, -(2**24), 0, 0, 1024, 0, 0, 0, 0, 0)
    imu = struct.pack("<12h", 0, 0, 2048, 0, 0, -2048, 0, 0, 0, 9, 9, 9)
    power = struct.pack("<Hhf", 7680, 800, 1.5)  # 24 V, 1 A
    payload = struct.pack("<H", 1002) + 6 * motors + imu + power + struct.pack("<HHH", 5, 0, 0)
    with own, other:
        link = solo8.Solo8(own, np.zeros(8), np.ones(8), 0.2)
        reading = make_reading()
        link.send(Mode.OFF, order, 10**9)
        other.send(solo8.frame(solo8.ANSWER_4.pack(4, 1002, 15)))
        other.send(solo8.frame(payload))
        assert link.receive(reading, 10**9)
        link.send(Mode.OFF, order, 10**9)
        sent = [solo8.payload_of(other.recv(2048)) for _ in range(2)]
    turn = 2 * np.pi / 9  # of the joint, for one of the motor
    expected = turn * solo8.SIGNS * np.where(solo8.MOTORS % 2, -1, 1)
    assert reading["joint_pos"][:8] == pytest.approx(expected)
    assert reading["gyro"] == pytest.approx([0.0, 0.0, -1.0])
    assert reading["acc"] == pytest.approx([0.0, 0.0, 9.80665])
    assert len(sent[1]) == 172
    assert sent[1][:2] == struct.pack("<H", 1002)


def test_a_board_of_protocol_4_that_refuses_protocol_3_is_asked_in_its_own(order):
    own, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with own, other:
        link = solo8.Solo8(own, np.zeros(8), np.ones(8), 0.2)
        link.send(Mode.OFF, order, 10**9)
        other.send(solo8.frame(solo8.ANSWER_4.pack(4, 1001, 15)))  # no session has begun
        link.receive(make_reading(), 10**9)
        link.send(Mode.OFF, order, 10**9)
        greetings = [solo8.payload_of(other.recv(2048)) for _ in range(2)]
        assert greetings == [solo8.HELLO.pack(3, 1001), solo8.HELLO.pack(4, 1002)]


def test_a_solo8_of_protocol_4_finds_its_zeros(tmp_path):
    rig = Rig("solo8", tmp_path, world=lambda rig: solo8_world(rig, protocol=4))
    calibrate_hung_up(rig)
    assert rig.electronics.state == "active"
    reading = rig.channel.readings.get()
    assert reading["joint_pos"][:8] == pytest.approx(rig.plant.data.qpos[7:], abs=0.15)
    rig.electronics.close()


@pytest.mark.parametrize("text", ["", "[1, 2]", "{", "[1,2,3,4,5,6,7,null]"])
def test_a_calibration_that_makes_no_sense_is_one_line(text, tmp_path):
    (tmp_path / "zeros.json").write_text(text)
    with pytest.raises(LinkError, match="--calibration"):
        solo8.read_calibration(str(tmp_path / "zeros.json"))


def test_go1_reads_what_it_is_told():
    state = np.zeros((), go1.STATE)
    state["head"], state["level"], state["charge"], state["tick"] = (0xFE, 0xEF), 0xFF, 63, 5
    state["motor"]["tau"], state["motor"]["temperature"] = -512, 41
    state["imu"]["quat"] = 0.5, 0.5, 0.5, 0.5
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as robot:
        robot.bind(("127.0.0.1", 0))
        link = go1.Go1(f"127.0.0.1:{robot.getsockname()[1]}", 12, 5.0, 0)
        link.send(Mode.OFF, np.zeros((), ORDER), 0)
        _, peer = robot.recvfrom(2048)
        reading = make_reading()

        def arrives(data):
            robot.sendto(data, peer)
            return link.receive(reading, 10**9)

        assert arrives(go1.seal(state))
        assert not arrives(go1.seal(state))  # doubled
        state["tick"] = 4
        assert not arrives(go1.seal(state))  # late
        assert not arrives(b"noise")
        assert reading["flags"] & Flag.TORN
        link.close()
    assert reading["battery"] == pytest.approx(0.63)
    assert (reading["torque"] == -2.0).all()
    assert (reading["temperature"] == 41).all()
    assert reading["quat"] == pytest.approx([0.5] * 4)
