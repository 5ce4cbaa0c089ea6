"""The MuJoCo model of the environment: a robot's scene plus the sensors that the MDP reads."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco

from kiras_rl.envs.terrain_geoms import TerrainGeoms, add_terrain, terrain_geoms
from kiras_rl.envs.terrain_library import TerrainLibrary
from kiras_rl.robots.robot import Robot

_OBJ = mujoco.mjtObj
_SENSOR = mujoco.mjtSensor
TOLERANCE = 1e-4  # of the solver; below it motions change less than by any other option
_NET_FORCE = 3  # contact sensor: sum of all contact forces, in the world frame


@dataclass(frozen=True)
class SensorLayout:
    """Where each quantity lies in `sensordata`; a slice spans all feet, joints or geoms.

    Attributes:
        foot_vel_w: Velocities of the centres of the foot spheres, F * 3, m/s.
        foot_force_w: Net contact force of each foot on the ground, F * 3, N.
        base_force_w: The same for the geoms of the base, B * 3, N.
        limb_force_w: The same for the penalised geoms, L * 3, N.
        joint_torque: Torques that actuators give to joints, J, N m.
        motion: Orientation of the base (w, x, y, z), its angular velocity in the base frame,
            rad/s, joint angles, rad, and joint velocities, rad/s, 7 + 2 J; None where no
            observation is late.
    """

    foot_vel_w: slice
    foot_force_w: slice
    base_force_w: slice
    limb_force_w: slice
    joint_torque: slice
    motion: slice | None = None

    @property
    def forces_w(self) -> slice:
        """Contact forces of feet, base and limbs, which follow each other."""
        return slice(self.foot_force_w.start, self.limb_force_w.stop)

    @property
    def geoms(self) -> tuple[int, int, int]:
        """Numbers of feet and of geoms of base and limbs, F, B and L."""
        parts = (self.foot_force_w, self.base_force_w, self.limb_force_w)
        feet, base, limbs = ((part.stop - part.start) // 3 for part in parts)
        return feet, base, limbs


@dataclass(frozen=True)
class Scene:
    """A compiled model with the addresses that the environment needs.

    `terrain` holds what a simulation writes to show a tile, None on flat ground.
    """

    model: mujoco.MjModel
    sensors: SensorLayout
    base_body: int
    robot_geoms: list[int]
    terrain: TerrainGeoms | None = None


def build_scene(
    robot: Robot,
    timestep: float,
    solver_iterations: int,
    max_delay: int = 0,
    observation_delay: int = 0,
    library: TerrainLibrary | None = None,
    visuals: bool = False,
) -> Scene:
    """Compile the scene of a robot.

    Args:
        robot: The robot.
        timestep: Physics step, s.
        solver_iterations: Newton and line-search iterations at most.
        max_delay: Longest actuation delay in physics steps; 0 allocates no delay buffers.
        observation_delay: Longest delay of observations in physics steps; 0 adds no sensors.
        library: Tiles that a world may show; None for flat ground, which costs nothing.
        visuals: Keep the geoms that are only looked at.
    """
    spec = robot.spec(visuals=visuals)
    spec.option.timestep = timestep
    spec.option.iterations = solver_iterations
    spec.option.ls_iterations = solver_iterations
    spec.option.tolerance = TOLERANCE
    if max_delay:
        for actuator in spec.actuators:
            actuator.nsample = max_delay
    if library is not None:
        add_terrain(spec, library)
    names = _add_sensors(spec, robot)
    motion = _add_motion_sensors(spec, robot) if observation_delay else []
    model = spec.compile()
    return Scene(
        model=model,
        sensors=SensorLayout(
            **{key: _span(model, value) for key, value in names.items()},
            motion=_span(model, motion) if motion else None,
        ),
        base_body=model.body(robot.base_body).id,
        robot_geoms=[i for i in range(model.ngeom) if model.geom_priority[i] > 0],
        terrain=None if library is None else terrain_geoms(model, library),
    )


def _add_sensors(spec: mujoco.MjSpec, robot: Robot) -> dict[str, list[str]]:
    """Add all sensors, grouped so that each quantity is contiguous; return their names."""

    def add(prefix: str, kind: mujoco.mjtSensor, objtype: mujoco.mjtObj, objects: tuple) -> list:
        for name in objects:
            sensor = spec.add_sensor(name=f"{prefix}/{name}", type=kind)
            sensor.objtype, sensor.objname = objtype, name
            if kind == _SENSOR.mjSENS_CONTACT:
                force = 1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE)
                sensor.intprm[:3] = [force, _NET_FORCE, 1]
        return [f"{prefix}/{name}" for name in objects]

    contact, geom = _SENSOR.mjSENS_CONTACT, _OBJ.mjOBJ_GEOM
    return {
        "foot_vel_w": add("vel", _SENSOR.mjSENS_FRAMELINVEL, geom, robot.foot_geoms),
        "foot_force_w": add("foot", contact, geom, robot.foot_geoms),
        "base_force_w": add("base", contact, geom, robot.base_geoms),
        "limb_force_w": add("limb", contact, geom, robot.penalised_geoms),
        # What the joint gets: the MJCF may limit it (actuatorfrcrange) more than the actuator.
        "joint_torque": add(
            "torque", _SENSOR.mjSENS_JOINTACTFRC, _OBJ.mjOBJ_JOINT, robot.joint_names
        ),
    }


def _add_motion_sensors(spec: mujoco.MjSpec, robot: Robot) -> list[str]:
    """Add sensors of what the robot's own sensors read; return their names in order.

    They sit in the base frame, not at an IMU's site: errors of the IMU belong to each world.
    """

    def add(kind: mujoco.mjtSensor, objtype: mujoco.mjtObj, name: str) -> str:
        sensor = spec.add_sensor(name=f"{kind.name}/{name}", type=kind)
        sensor.objtype, sensor.objname = objtype, name
        return sensor.name

    base = spec.body(robot.base_body).add_site(name="motion/base").name
    return [
        add(_SENSOR.mjSENS_FRAMEQUAT, _OBJ.mjOBJ_SITE, base),
        add(_SENSOR.mjSENS_GYRO, _OBJ.mjOBJ_SITE, base),
        *(add(_SENSOR.mjSENS_JOINTPOS, _OBJ.mjOBJ_JOINT, joint) for joint in robot.joint_names),
        *(add(_SENSOR.mjSENS_JOINTVEL, _OBJ.mjOBJ_JOINT, joint) for joint in robot.joint_names),
    ]


def _span(model: mujoco.MjModel, names: list[str]) -> slice:
    sensors = [model.sensor(name) for name in names]
    start = int(sensors[0].adr[0])
    stop = start + sum(int(s.dim[0]) for s in sensors)
    return slice(start, stop)
