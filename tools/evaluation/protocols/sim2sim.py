"""Another simulator's eye on a policy file: what a gait owes to the physics of its training."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from kiras_rl.envs.quadruped import QuadrupedEnv
from kiras_rl.evaluation.flat import SETTLE as WARM_UP
from kiras_rl.evaluation.imitation import STEPS, Motion, record_motion
from kiras_rl.evaluation.strides import LEAST_SWING, Walk, describe
from kiras_rl.robots.robot import load_robot
from kiras_rl.tools.evaluation import sim2sim
from kiras_rl.tools.evaluation.protocols.rows import scaled, skill_table
from kiras_rl.tools.evaluation.protocols.subject import Subject
from kiras_rl.tools.evaluation.report.content import Cell, Column, Section, Table

TITLE = "Second simulator"
TEXT = (
    f"C MuJoCo at {1000 * sim2sim.TIMESTEP:g} ms with an elliptic friction cone; PD controller and "
    "motors outside of it; the policy by the code that runs on the robot. Every skill walks "
    f"straight ahead for {sim2sim.DURATION:g} s, of which the first {sim2sim.SETTLE:g} do not "
    f"count, and stands for {sim2sim.STANDING:g} s. A foot has lifted if it is off the ground for "
    f"{1000 * LEAST_SWING:.0f} ms or more. Definitions: docs/evaluation.md."
)
TRIALS = 20  # a skill, of walking and of standing each

POSTURE = (
    Column("height error", "cm", "{:.1f}", best="low"),
    Column("height - keyframe", "cm", "{:+.1f}"),
    Column("pitch error", "deg", "{:.1f}", best="low"),
    Column("pitch - keyframe", "deg", "{:+.1f}"),
    Column("v_x", "m/s", "{:+.2f}"),
    Column("falls", "%", "{:.0f}", best="low"),
)
GAIT = (
    Column("lifts of a foot", "1/s", "{:.2f}"),
    Column("of the foot that lifts least", "1/s", "{:.2f}"),
    Column("clearance", "cm", "{:.1f}"),
    Column("duty", "%", "{:.0f}"),
)
STANDING = (
    Column("drift", "cm", "{:.1f}", best="low"),
    Column("lifts of a foot", "1/s", "{:.2f}", best="low"),
    Column("feet on the ground", "%", "{:.0f}", best="high"),
    Column("height - keyframe", "cm", "{:+.1f}"),
    Column("pitch - keyframe", "deg", "{:+.1f}"),
    Column("falls", "%", "{:.0f}", best="low"),
)
BESIDE = (
    Column("height - keyframe", "cm", "{:+.1f}"),
    Column("pitch - keyframe", "deg", "{:+.1f}"),
    Column("v_x", "m/s", "{:+.2f}"),
    Column("lifts of a foot", "1/s", "{:.2f}"),
    Column("clearance", "cm", "{:.1f}"),
    Column("duty", "%", "{:.0f}"),
    Column("power", "W", "{:.1f}"),
)
BESIDE_NOTE = (
    "Both once a control step, so that the numbers differ from those above. Training: the same "
    f"friction, nothing else randomized, {STEPS} steps after {WARM_UP:g} s."
)


def measure(subject: Subject) -> dict:
    """Return the results by skill, and whose joint limits they are measured by."""
    pieces = {_key(subject, skill): partial(_try, subject, skill) for skill in subject.skills}
    training, run = _training(subject)
    results = subject.results({**pieces, training: run})
    return {
        "limits": _limits(subject)[0],
        "skills": {
            skill: results[_key(subject, skill)] | {"training": results[training][skill]}
            for skill in subject.skills
        },
    }


def section(results: dict[str, dict]) -> Section:
    """Return tables of walking, of what it asks of the motors, of standing, and of both physics."""

    def part(name: str) -> dict[str, dict[str, dict]]:
        return {
            label: {skill: parts[name] for skill, parts in values["skills"].items()}
            for label, values in results.items()
        }

    walk = part("walk")
    tables = [
        skill_table("Posture in the second simulator", POSTURE, walk, _posture),
        skill_table("Gait in the second simulator", GAIT, walk, _gait),
        _loads(results, walk),
        skill_table("Standing in the second simulator", STANDING, part("stand"), _standing),
        _beside(walk, part("training")),
    ]
    return Section("sim2sim", TITLE, TEXT, tables)


def _key(subject: Subject, skill: str) -> str:
    options = subject.options
    trials, command = options.trials_or(TRIALS), options.command
    return subject.key("sim2sim", skill=skill, trials=trials, command=command)


def _try(subject: Subject, skill: str) -> dict:
    options, tell = subject.options, subject.progress.tell
    trials = sim2sim.Trials(options.trials_or(TRIALS), (options.command,), tell)
    limits = _limits(subject)[1]
    return sim2sim.try_skill(subject.robot, subject.onboard, skill, trials, limits)


def _limits(subject: Subject) -> tuple[str, np.ndarray]:
    """Return where joint limits come from, and the limits, (J, 2), rad."""
    metadata = subject.onboard.metadata
    if metadata.joint_limits is not None:
        return "the policy file's", np.array(metadata.joint_limits)
    return "robot.yaml's, because the policy file has none", load_robot(metadata.robot).joint_limits


def _training(subject: Subject) -> tuple[str, Callable[[], dict]]:
    """Return the key of the results in the physics of the training, and what measures them."""
    options = subject.options
    trials = options.trials_or(TRIALS)
    exact = replace(subject, options=replace(options, nominal=True))

    def run() -> dict:
        config = exact.flat()
        config.env.randomization.friction = sim2sim.FRICTION
        duration = WARM_UP + STEPS * config.sim.timestep * config.sim.substeps
        env = exact.make_env(config, trials * len(subject.skills), duration)
        return _describe(record_motion(env, exact.policy_in(env), options.command), env)

    return exact.key("sim2sim/training", trials=trials, command=options.command), run


def _describe(motion: Motion, env: QuadrupedEnv) -> dict[str, dict]:
    """Return posture and gait by skill."""
    skill = motion.skill.tolist()
    return {
        name: describe(
            [_walk(motion, robot) for robot, its in enumerate(skill) if its == index],
            env.keyframe_height[index].item(),
            env.keyframe_pitch[index].item(),
        )
        for index, name in enumerate(env.skills)
    }


def _walk(motion: Motion, robot: int) -> Walk:
    """Return what one robot did until it fell."""
    steps = int(motion.alive[:, robot].sum())
    names = ("height", "pitch", "velocity", "foot_height", "power")
    arrays = {name: getattr(motion, name)[:steps, robot].cpu().numpy() for name in names}
    stands = motion.stands[:steps, robot].cpu().numpy()
    return Walk(dt=motion.step_dt, contact=stands, **arrays)


def _posture(r: dict) -> tuple[Cell, ...]:
    return (
        scaled(r["height_error"], 100),
        scaled(r["height"], 100),
        scaled(r["pitch_error"], 180 / math.pi),
        scaled(r["pitch"], 180 / math.pi),
        r["velocity"],
        scaled(r["falls"], 100),
    )


def _gait(r: dict) -> tuple[Cell, ...]:
    least = None if r["lifts"] is None else min(r["lifts"])
    return _lifts(r), least, scaled(r["clearance"], 100), scaled(r["duty"], 100)


def _lifts(r: dict) -> float | None:
    """Return the mean over feet, 1/s."""
    return None if r["lifts"] is None else sum(r["lifts"]) / len(r["lifts"])


def _loads(results: dict[str, dict], walk: dict[str, dict[str, dict]]) -> Table:
    peaks = [r["peak_torque"] or {} for skills in walk.values() for r in skills.values()]
    kinds = list(dict.fromkeys(kind for peak in peaks for kind in peak))
    columns = (
        Column("beyond joint limits", "% of control steps", "{:.2f}", best="low"),
        Column("a motor saturated", "% of steps", "{:.2f}", best="low"),
        *(Column(f"peak torque {kind}", "N m") for kind in kinds),
        Column("peak speed", "rad/s", "{:.1f}"),
        Column("power", "W", "{:.1f}"),
    )

    def cells(r: dict) -> tuple[Cell, ...]:
        shares = scaled(r["beyond"], 100), scaled(r["saturated"], 100)
        torques = ((r["peak_torque"] or {}).get(kind) for kind in kinds)
        return (*shares, *torques, r["peak_speed"], r["power"])

    sources = dict.fromkeys(values["limits"] for values in results.values())
    note = f"Joint limits: {'; or '.join(sources)}. A saturated motor gives less than it is asked."
    return skill_table("Joints and motors in the second simulator", columns, walk, cells, note)


def _standing(r: dict) -> tuple[Cell, ...]:
    return (
        scaled(r["drift"], 100),
        _lifts(r),
        scaled(r["duty"], 100),
        scaled(r["height"], 100),
        scaled(r["pitch"], 180 / math.pi),
        scaled(r["falls"], 100),
    )


def _beside(walk: dict[str, dict[str, dict]], training: dict[str, dict[str, dict]]) -> Table:
    """Return a table with two rows for each skill of each policy."""
    columns = (Column("skill"), Column("policy"), Column("physics"), *BESIDE)
    rows = []
    for label, skills in walk.items():
        for skill, values in skills.items():
            rows.append((skill, label, "training", *_compared(training[label][skill])))
            rows.append((skill, label, "second", *_compared(values["sampled"])))
    return Table("Beside the physics of the training", columns, rows, BESIDE_NOTE)


def _compared(r: dict) -> tuple[Cell, ...]:
    return (
        scaled(r["height"], 100),
        scaled(r["pitch"], 180 / math.pi),
        r["velocity"],
        _lifts(r),
        scaled(r["clearance"], 100),
        scaled(r["duty"], 100),
        r["power"],
    )
