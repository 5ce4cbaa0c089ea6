"""What the three processes tell each other: fixed structs, little endian, without pointers.

All times are nanoseconds of CLOCK_MONOTONIC, which no change of the wall clock moves and which the
processes of one computer share. Joints follow the policy file; entries beyond its last joint are 0.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag

import numpy as np

MAX_JOINTS = 12
NANO = 1_000_000_000  # ns in a second


class Mode(IntEnum):
    """What a driver does with the motors."""

    OFF = 0
    """No torque."""
    CALIBRATE = 1
    """Find the zero of the joints: the driver's own motion."""
    DAMP = 2
    """torque = -kd dq with the damping of the robot's profile."""
    HOLD = 3
    """The last targets and gains, because no newer order came in time."""
    SERVO = 4
    """torque = kp (target - q) - kd dq."""


class State(IntEnum):
    """Where the runtime is."""

    OFF = 0
    """No reading yet."""
    CONNECTED = 1
    """Readings come, motors are off."""
    CALIBRATED = 2
    """The zeros of the joints are known."""
    LYING = 3
    RISING = 4
    STANDING = 5
    POLICY = 6
    LOWERING = 7
    DAMPED = 8
    """After a fault or an emergency stop, until the operator acknowledges."""


class Request(IntEnum):
    """What an operator asks for, once a press."""

    NONE = 0
    STAND = 1
    LIE = 2
    WALK = 3
    """Let the policy drive."""
    ACKNOWLEDGE = 4
    """Leave OFF's read-only state, or DAMPED."""
    SAVE = 5
    """Write the black box."""
    QUIT = 6
    """Lie down, and end."""


class Flag(IntFlag):
    """What a driver says beside the numbers of a reading."""

    CALIBRATED = 1
    MOTOR_ERROR = 2
    OTHER_CONTROLLER = 4
    """Somebody else commands the motors."""
    EMERGENCY = 8
    """The button of the robot's own remote."""
    TORN = 16
    """Messages of the robot were lost, late or damaged in the last period."""
    LATCHED = 32
    """The driver damps by itself, and goes on until an order agrees."""


READING = np.dtype(
    [
        ("seq", "<u8"),  # counts measurements, from 1
        ("time", "<i8"),  # ns, when the driver got it
        ("order", "<u8"),  # seq of the newest order that the driver knew
        ("mode", "<u4"),  # Mode that the driver is in
        ("flags", "<u4"),  # Flag
        ("joint_pos", "<f4", MAX_JOINTS),  # rad
        ("joint_vel", "<f4", MAX_JOINTS),  # rad/s
        ("torque", "<f4", MAX_JOINTS),  # N m, as the motors tell it
        ("temperature", "<f4", MAX_JOINTS),  # degrees Celsius, of the motors; NaN: not measured
        ("quat", "<f4", 4),  # w x y z, base to world
        ("gyro", "<f4", 3),  # rad/s, base frame
        ("acc", "<f4", 3),  # m/s^2, base frame, (0, 0, 9.81) at rest
        ("battery", "<f4"),  # share of its charge, 0 to 1; NaN: not measured
        ("remote", "u1", 40),  # the robot's own remote, as it came
    ]
)
"""From driver to runtime, at the driver's rate."""

ORDER = np.dtype(
    [
        ("seq", "<u8"),  # from 1
        ("time", "<i8"),  # ns, when the runtime made it
        ("valid_until", "<i8"),  # ns; later the driver holds, then damps
        ("mode", "<u4"),  # Mode: OFF, CALIBRATE, DAMP or SERVO
        ("state", "<u4"),  # State
        ("skill", "<u4"),  # index
        ("command", "<f4", 3),  # v_x, v_y in m/s, yaw rate in rad/s, base frame
        ("target", "<f4", MAX_JOINTS),  # rad
        ("kp", "<f4", MAX_JOINTS),  # N m/rad
        ("kd", "<f4", MAX_JOINTS),  # N m s/rad
    ]
)
"""From runtime to driver, at the policy's control rate."""

WISH = np.dtype(
    [
        ("seq", "<u8"),  # from 1
        ("time", "<i8"),  # ns
        ("connected", "u1"),  # whether there is something in somebody's hand
        ("emergency", "u1"),  # held down now
        ("held", "u1"),  # the dead-man's button
        ("request", "u1"),  # Request: the last one
        ("requests", "<u4"),  # how many there were
        ("skill", "<u4"),  # index
        ("command", "<f4", 3),  # v_x, v_y in m/s, yaw rate in rad/s, base frame
    ]
)
"""From operator to runtime and driver, fifty times a second."""


GUEST = np.dtype(
    [
        ("seq", "<u8"),  # from 1
        ("time", "<i8"),  # ns
        ("command", "<f4", 3),  # v_x, v_y in m/s, yaw rate in rad/s, base frame
    ]
)
"""From another program to the operator, which drives by it while its own hands rest."""


def make_reading() -> np.ndarray:
    """Return an empty reading: level, at rest, temperatures and battery not measured. Shape ()."""
    reading = np.zeros((), READING)
    reading["quat"] = 1.0, 0.0, 0.0, 0.0
    reading["temperature"] = reading["battery"] = np.nan
    return reading
