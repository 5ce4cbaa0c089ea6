"""What the runtime has to know of a robot beside the policy file: rates, damping, thresholds.

Joint ranges, speeds, torques, gains, postures and commands are those of the policy file. What is
here belongs to the robot's electronics, or is our own caution, and says which.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Profile:
    """Numbers of one robot."""

    name: str
    rate: float
    """Of the driver, Hz."""
    damping: float
    """Of Mode.DAMP, N m s/rad, each joint."""
    max_power: float
    """Mechanical power of all joints that push, mean over half a second, W."""
    max_temperature: float
    """Of a motor, degrees Celsius."""
    min_battery: float
    """Share of the charge."""
    needs_calibration: bool
    """Whether the zeros of the joints are unknown after power-on."""
    max_kp: float
    """Largest position gain that the electronics can carry, N m/rad."""


PROFILES = {
    # rate and damping: odri_control_interface at dcc07e4 and its safety controller, 0.2 N m s/rad.
    # max_kp: 15.99 A/turn, where the signed Q11 of the master board's protocol ends, behind 9:1 at
    # 0.025 N m/A. Motors and battery are not measured. max_power: ours; walking takes 14 W at most.
    "solo8": Profile(
        name="solo8",
        rate=1000.0,
        damping=0.2,
        max_power=60.0,
        max_temperature=np.inf,
        min_battery=0.0,
        needs_calibration=True,
        max_kp=5.15,
    ),
    # rate: the examples of unitree_legged_sdk 3.8, dt = 0.002 s. max_kp: int16 in steps of 1/32.
    # damping, power, temperature and battery: ours; walking takes 180 W at most.
    "go1": Profile(
        name="go1",
        rate=500.0,
        damping=5.0,
        max_power=700.0,
        max_temperature=75.0,
        min_battery=0.10,
        needs_calibration=False,
        max_kp=1023.0,
    ),
}
"""By the robot's name in the policy file."""


def profile_of(robot: str) -> Profile:
    """Return the profile of a robot, or of one of its variants (solo8:12A).

    Raises:
        KeyError: If there is none; the text says which there are.
    """
    name = robot.partition(":")[0]
    if name not in PROFILES:
        raise KeyError(
            f"kiras-robot has no profile of robot '{robot}'; it has: {', '.join(PROFILES)} "
            "(kiras_rl/deploy/runtime/profiles.py)"
        )
    return PROFILES[name]
