"""Our messages against the makers' own libraries, in an environment of their own."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import venv

import numpy as np
import pytest
from patience import patience

from kiras_rl.deploy.runtime import go1, solo8
from kiras_rl.deploy.runtime.messages import ORDER, Mode

pytestmark = pytest.mark.slow

WHEELS = ("unitree-legged-sdk==3.8.20231105", "master-board==1.0", "cmeel-boost")

GO1 = """
import json, sys, time
from unitree_legged_sdk import robot_interface as sdk
udp = sdk.UDP(0xFF, int(sys.argv[1]), "127.0.0.1", int(sys.argv[2]))
command, state = sdk.LowCmd(), sdk.LowState()
udp.InitCmdData(command)
given = json.loads(sys.argv[3])
for i, (q, kp, kd) in enumerate(given):
    motor = command.motorCmd[i]
    motor.mode, motor.q, motor.dq, motor.tau, motor.Kp, motor.Kd = 0x0A, q, 0.0, 0.0, kp, kd
udp.SetSend(command)
udp.Send()
input()
udp.Recv()
udp.GetRecv(state)
motors = [[m.q, m.dq, m.tauEst, m.temperature] for m in state.motorState[:12]]
imu = [list(state.imu.quaternion), list(state.imu.gyroscope), list(state.imu.accelerometer)]
print(json.dumps([motors, imu, state.bms.SOC, state.tick, list(state.wirelessRemote)]))
"""

BOARD = """
import json, sys, time
import libmaster_board_sdk_pywrap as sdk
board = sdk.MasterBoardInterface("ea0")
board.Init()
given = json.loads(sys.argv[1])
for i in range(4):
    driver = board.GetDriver(i)
    driver.motor1.Enable(); driver.motor2.Enable()
    driver.EnablePositionRolloverError(); driver.SetTimeout(5); driver.Enable()
for i, (position, kp, kd, current) in enumerate(given):
    motor = board.GetMotor(i)
    motor.SetPositionReference(position); motor.SetKp(kp); motor.SetKd(kd)
    motor.SetSaturationCurrent(current)
while not board.IsAckMsgReceived() and not board.IsTimeout():
    board.SendInit()
    time.sleep(0.001)
for _ in range(100):
    board.ParseSensorData()
    board.SendCommand()
    time.sleep(0.001)
board.ParseSensorData()
motors = [board.GetMotor(i) for i in range(8)]
found = [[m.GetPosition(), m.GetVelocity(), m.GetCurrent(), m.IsReady()] for m in motors]
imu = [[f(i) for i in range(3)] for f in (
    board.imu_data_gyroscope, board.imu_data_accelerometer, board.imu_data_attitude)]
print("FOUND", json.dumps([found, imu, board.GetSessionId(), board.IsTimeout()]), flush=True)
"""

FAKE = """
import sys, time
import numpy as np
from kiras_rl.deploy.runtime import solo8
wire = solo8.open_socket("eb0")
wire.settimeout(20)
sensor = np.frombuffer(bytearray.fromhex(sys.argv[1]), solo8.SENSOR)[0].copy()
last = b""
try:
    while True:
        payload = solo8.payload_of(wire.recv(2048))
        if len(payload) == solo8.HELLO.size:
            protocol, session = solo8.HELLO.unpack(payload)
            wire.send(solo8.frame(solo8.ANSWER.pack(session, 0b1111)))
            wire.settimeout(1)
        elif len(payload) == solo8.COMMAND.itemsize:
            last = payload
            sensor["session"] = session
            sensor["index"] += 1
            wire.send(solo8.frame(sensor.tobytes()))
except OSError:
    print("COMMAND", protocol, last.hex(), flush=True)
"""


@pytest.fixture(scope="module")
def makers(tmp_path_factory):
    """An interpreter that has the makers' wheels; they want an older numpy than we do."""
    folder = tmp_path_factory.mktemp("makers")
    venv.create(folder, with_pip=True)
    python = folder / "bin" / "python"
    words = [str(python), "-m", "pip", "install", "-q", *WHEELS]
    done = subprocess.run(words, capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"the makers' wheels do not install here: {done.stderr.strip()[-200:]}")
    return python


def test_go1_s_messages_are_the_maker_s_in_both_directions(makers):
    random = np.random.default_rng(1)
    order = np.zeros((), ORDER)
    order["target"], order["kp"], order["kd"] = random.normal(0, 1, 12), 35.3, 0.7
    state = np.zeros((), go1.STATE)
    state["head"], state["level"], state["tick"], state["charge"] = (0xFE, 0xEF), 0xFF, 123456, 77
    motor = state["motor"]
    motor["q"], motor["dq"] = random.normal(0, 1, 20), random.normal(0, 9, 20)
    motor["tau"], motor["temperature"] = random.integers(-6000, 6000, 20), range(20, 40)
    for name in ("quat", "gyro", "acc"):
        state["imu"][name] = random.normal(0, 1, state["imu"][name].shape)
    state["remote"] = range(40)

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as robot:
        robot.bind(("127.0.0.1", 0))
        robot.settimeout(patience())
        given = [[float(order[name][i]) for name in ("target", "kp", "kd")] for i in range(12)]
        ports = str(free_port()), str(robot.getsockname()[1])
        words = [str(makers), "-c", GO1, *ports, json.dumps(given)]
        child = subprocess.Popen(words, stdin=-1, stdout=-1, text=True)
        command, peer = robot.recvfrom(2048)
        robot.sendto(go1.seal(state), peer)
        printed, _ = child.communicate("\n", patience())
    assert command == go1.encode(Mode.SERVO, order, 12, 5.0)
    motors, imu, charge, tick, remote = json.loads(printed.splitlines()[-2])
    assert np.allclose([m[:2] for m in motors], np.stack([motor["q"], motor["dq"]], 1)[:12])
    assert [m[2] for m in motors] == (motor["tau"][:12] / 256).tolist()
    assert [m[3] for m in motors] == motor["temperature"][:12].tolist()
    names = ("quat", "gyro", "acc")
    assert all(np.allclose(imu[i], state["imu"][name]) for i, name in enumerate(names))
    assert (charge, tick, remote) == (77, 123456, list(range(40)))


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
        trial.bind(("", 0))
        return trial.getsockname()[1]


@pytest.mark.skipif(
    os.geteuid() != 0 or not shutil.which("unshare") or not shutil.which("ip"),
    reason="a network of two Ethernet interfaces takes root, unshare and ip",
)
def test_solo8_s_frames_are_the_maker_s_in_both_directions(makers, tmp_path):
    random = np.random.default_rng(2)
    targets = random.uniform(-1, 1, 8)
    full = np.ones(8)
    command = solo8.encode(targets, 4.9 * full, 0.1 * full, 1.8 * full, 0xF005)
    by_motor = np.empty(8)
    by_motor[solo8.MOTORS] = solo8.SIGNS * 9.0 * targets
    per_amp = 81 * 0.025
    given = [[float(q), 4.9 / per_amp, 0.1 / per_amp, 8.0] for q in by_motor]

    sensor = np.zeros((), solo8.SENSOR)
    boards = sensor["board"][:4]
    boards["position"] = random.integers(-(2**28), 2**28, (4, 2))
    boards["velocity"] = random.integers(-9000, 9000, (4, 2))
    boards["current"] = random.integers(-9000, 9000, (4, 2))
    boards["status"] = int(solo8.READY.sum())
    for name in ("gyro", "acc", "attitude"):
        sensor[name] = random.integers(-6000, 6000, 3)

    for name, code in (("fake.py", FAKE), ("board.py", BOARD)):
        (tmp_path / name).write_text(code)
    prefix = next(makers.parent.parent.glob("lib/python*/site-packages/cmeel.prefix"))
    script = f"""
        set -e
        ip link add ea0 type veth peer name eb0
        ip link set ea0 up
        ip link set eb0 up
        '{sys.executable}' '{tmp_path}/fake.py' {sensor.tobytes().hex()} &
        sleep 2
        LD_LIBRARY_PATH='{prefix}/lib' timeout 60 '{makers}' '{tmp_path}/board.py' \
            '{json.dumps(given)}' || true
        wait
    """
    done = subprocess.run(
        ["unshare", "-n", "bash", "-c", script], capture_output=True, text=True, timeout=patience()
    )
    lines = dict(line.split(" ", 1) for line in done.stdout.splitlines() if line[:1] in "FC")
    assert {"COMMAND", "FOUND"} <= set(lines), done.stdout + done.stderr
    protocol, sent = lines["COMMAND"].split()
    assert int(protocol) == 3
    # Session and index are the run's own. The SDK computes in float where we do in double: the
    # last bit of a position may differ.
    theirs = np.frombuffer(bytes.fromhex(sent), solo8.COMMAND)[0]
    ours = np.array(command["board"])
    assert np.abs(theirs["board"]["position"] - ours["position"]).max() <= 16
    for name in ("mode", "velocity", "current", "kp", "kd", "saturation"):
        assert np.array_equal(theirs["board"][name], ours[name]), name

    found, imu, session, timed_out = json.loads(lines["FOUND"])
    assert (theirs["session"], timed_out) == (session, False)
    flat = [boards[name].reshape(-1) for name in ("position", "velocity", "current")]
    scales = 2 * np.pi / 2**24, 2000 * np.pi / 60 / 2**11, 1 / 2**10
    for column, (values, scale) in enumerate(zip(flat, scales, strict=True)):
        assert np.allclose([motor[column] for motor in found], values * scale, rtol=1e-5)
    assert all(motor[3] for motor in found)
    units = 1 / 2**11, 9.80665 / 2**11, 1 / 2**13
    for values, name, unit in zip(imu, ("gyro", "acc", "attitude"), units, strict=True):
        assert np.allclose(values, sensor[name] * unit, rtol=1e-5), name
