"""A node of ROS 2 beside kiras-robot: tells what the robot measures, and passes velocities on.

    kiras-robot go1 policy.onnx --guest          # in one terminal, with the gamepad
    python3 kiras_bridge.py go1 policy.onnx      # in another one, where ROS 2 is sourced

It publishes /joint_states (sensor_msgs/JointState) and /imu (sensor_msgs/Imu) at 50 Hz, and hears
/cmd_vel (geometry_msgs/Twist). It is outside of what keeps the robot safe: kiras-robot takes its
velocities only while the gamepad's sticks have rested for two seconds, within all limits, and for a
quarter of a second each; buttons, and the emergency stop first of all, are the gamepad's alone. A
node that hangs or dies changes nothing but that.

Frames are those of REP 103: x forward, y left, z up; the IMU's is the robot's base.

Letters: J joints.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.deploy.runtime.driver import Channel
from kiras_rl.deploy.runtime.messages import GUEST, NANO

RATE = 50.0  # Hz, of what is published
FRAME = "base_link"


def joint_state(reading: np.ndarray, names: Sequence[str]) -> dict[str, Any]:
    """Return the fields of a JointState.

    Args:
        reading: READING, shape ().
        names: Of the policy's joints, J.

    Returns:
        name, position in rad, velocity in rad/s and effort in N m, J each.
    """
    fields = {"position": "joint_pos", "velocity": "joint_vel", "effort": "torque"}
    values = {key: reading[name][: len(names)].tolist() for key, name in fields.items()}
    return {"name": list(names), **values}


def imu(reading: np.ndarray) -> dict[str, dict[str, float]]:
    """Return the fields of an Imu: orientation, rad/s and m/s^2 in the base frame.

    The orientation is from base to world, its yaw without a reference; gravity is in the
    acceleration, (0, 0, 9.81) at rest.

    Args:
        reading: READING, shape ().
    """
    w, x, y, z = (float(value) for value in reading["quat"])

    def vector(name: str) -> dict[str, float]:
        x, y, z = (float(value) for value in reading[name])
        return {"x": x, "y": y, "z": z}

    return {
        "orientation": {"x": x, "y": y, "z": z, "w": w},
        "angular_velocity": vector("gyro"),
        "linear_acceleration": vector("acc"),
    }


def guest(seq: int, linear: Any, angular: Any, now: int) -> np.ndarray:
    """Return the GUEST, shape (), that a Twist means.

    Args:
        seq: Its number, from 1.
        linear: With x and y in m/s, base frame.
        angular: With z in rad/s.
        now: CLOCK_MONOTONIC, ns.
    """
    message = np.zeros((), GUEST)
    message["seq"], message["time"] = seq, now
    message["command"] = linear.x, linear.y, angular.z
    return message


def stamp(reading: np.ndarray, now: int, clock: int) -> tuple[int, int]:
    """Return when a reading was measured by the clock of ROS, in s and ns.

    Args:
        reading: READING, shape (), which has the time of CLOCK_MONOTONIC.
        now: CLOCK_MONOTONIC, ns.
        clock: The clock of ROS at the same moment, ns.
    """
    return divmod(clock - (now - int(reading["time"])), NANO)


def fill(message: Any, fields: dict[str, Any]) -> Any:
    """Write nested fields into a message, and return it."""
    for name, value in fields.items():
        if isinstance(value, dict):
            fill(getattr(message, name), value)
        else:
            setattr(message, name, value)
    return message


class Bridge:
    """What the node does; the node itself only makes publishers, a subscription and a timer."""

    def __init__(self, channel: Channel, names: Sequence[str]) -> None:
        """Take the memory that kiras-robot shares, and the names of the policy's joints."""
        self._channel, self._names = channel, names
        self._published = self._heard = 0

    def hear(self, twist: Any, now: int) -> None:
        """Pass a Twist on, heard at a time of CLOCK_MONOTONIC, ns."""
        self._heard += 1
        self._channel.guests.put(guest(self._heard, twist.linear, twist.angular, now))

    def news(self, now: int, clock: int) -> tuple[dict[str, Any], dict[str, Any]] | None:
        """Return the fields of a JointState and of an Imu, or None without a new reading.

        Args:
            now: CLOCK_MONOTONIC, ns.
            clock: The clock of ROS at the same moment, ns.
        """
        reading = self._channel.readings.get()
        if reading is None or int(reading["seq"]) == self._published:
            return None
        self._published = int(reading["seq"])
        seconds, nanoseconds = stamp(reading, now, clock)
        head = {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": FRAME}
        return (
            {"header": head, **joint_state(reading, self._names)},
            {"header": head, **imu(reading)},
        )


def main() -> int:
    """Run the node until it is told to end; return the exit status."""
    if len(sys.argv) != 3:
        sys.stderr.write("error: kiras_bridge.py takes a robot and the policy file that runs\n")
        return 2
    import rclpy
    from geometry_msgs.msg import Twist
    from sensor_msgs.msg import Imu, JointState

    robot, policy = sys.argv[1:]
    bridge = Bridge(Channel(robot), OnboardPolicy(policy).metadata.joint_names)
    rclpy.init()
    node = rclpy.create_node("kiras_bridge")
    joints = node.create_publisher(JointState, "joint_states", 10)
    inertia = node.create_publisher(Imu, "imu", 10)
    node.create_subscription(Twist, "cmd_vel", lambda m: bridge.hear(m, time.monotonic_ns()), 1)

    def publish() -> None:
        found = bridge.news(time.monotonic_ns(), node.get_clock().now().nanoseconds)
        if found is not None:
            joints.publish(fill(JointState(), found[0]))
            inertia.publish(fill(Imu(), found[1]))

    node.create_timer(1.0 / RATE, publish)
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        return 0
    finally:
        node.destroy_node()
    return 0


if __name__ == "__main__":
    sys.exit(main())
