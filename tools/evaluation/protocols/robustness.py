"""One disturbance at a time, beyond what training had: where the policy breaks."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from kiras_rl.evaluation.flat import FLOOR, deal_skills, per_robot, record
from kiras_rl.schema import Config, RandomizationConfig
from kiras_rl.tools.evaluation.protocols.rows import colours, panels
from kiras_rl.tools.evaluation.protocols.subject import Subject
from kiras_rl.tools.evaluation.report.content import Column, Figure, Section, Table

TITLE = "Robustness"
TEXT = (
    "Every skill walks straight ahead for 10 s on flat ground while one disturbance is set to a "
    "value and all others are drawn as in training. Pushes come about every 5 s, each axis up to "
    "the value; biases, tilts and motors' strengths are drawn from minus to plus the value for "
    "each joint or axis. A robot succeeds if it does not fall and its "
    f"errors stay at the floor's: {100 * FLOOR.height:.0f} cm, "
    f"{math.degrees(FLOOR.pitch):.0f} degrees, {FLOOR.velocity:.2f} m/s."
)

Setter = Callable[[RandomizationConfig, float], None]
Round = Callable[[float], float]

DURATION = 10.0  # s
# At a friction of 0.1 and less the few of training leave contacts unsolved: worlds diverge, and
# robots fall that do not with more.
SOLVER_ITERATIONS = 20  # at least


@dataclass(frozen=True)
class Sweep:
    """Values of one disturbance.

    Attributes:
        name: How tables call it.
        unit: Of the values.
        values: From mild to hard.
        trained: The range of training.
        apply: Sets a value in the randomization.
    """

    name: str
    unit: str
    values: tuple[float, ...]
    trained: tuple[float, float]
    apply: Setter


def sweeps(config: Config) -> list[Sweep]:
    """Return the sweeps; sizes follow the robot's own randomization."""
    drawn, step = config.env.randomization, 1000.0 * config.sim.timestep

    def trained(name: str, scale: float = 1.0) -> tuple[float, float]:
        nominal = 1.0 if name.endswith("factor") else 0.0
        low, high = getattr(drawn, name) or (nominal, nominal)
        return scale * low, scale * high

    def spread(name: str) -> tuple[float, float]:
        low, high = trained(name)
        return 0.0, (high - low) / 2

    def fixed(name: str, scale: float = 1.0, unit: Round = float) -> Setter:
        return lambda r, value: setattr(r, name, (unit(value / scale), unit(value / scale)))

    def around(name: str, centre: float = 0.0) -> Setter:
        return lambda r, value: setattr(r, name, (centre - value, centre + value))

    payload = trained("payload")[1] or 0.25
    delays = tuple(step * k for k in (0, 2, 3, 4, 5, 6, 8))
    return [
        Sweep("push", "m/s", (0.0, 0.1, 0.3, 0.5, 0.7, 1.0, 1.5),
              spread("push_velocity"), around("push_velocity")),
        Sweep("payload", "kg", tuple(payload * k for k in (-2, 0, 1, 2, 3, 4, 6)),
              trained("payload"), fixed("payload")),
        Sweep("leg mass", "of the nominal", (0.7, 0.9, 1.0, 1.1, 1.3, 1.5),
              trained("leg_mass_factor"), fixed("leg_mass_factor")),
        Sweep("friction", "", (1.25, 0.8, 0.5, 0.2, 0.1, 0.05, 0.02), trained("friction"),
              fixed("friction")),
        Sweep("action delay", "ms", delays, trained("action_delay", step),
              fixed("action_delay", step, round)),
        Sweep("observation delay", "ms", tuple(step * k for k in range(5)),
              trained("observation_delay", step), fixed("observation_delay", step, round)),
        Sweep("torque limit", "of the motor's", (1.2, 1.0, 0.9, 0.8, 0.7, 0.6, 0.5),
              trained("torque_factor"), fixed("torque_factor")),
        Sweep("motor strength", "+-", (0.0, 0.1, 0.2, 0.3, 0.4), spread("motor_factor"),
              around("motor_factor", 1.0)),
        Sweep("joint friction", "of the nominal", (0.0, 1.0, 2.0, 3.0, 5.0, 8.0),
              trained("joint_friction_factor"), fixed("joint_friction_factor")),
        Sweep("joint damping", "of the nominal", (0.0, 1.0, 2.0, 10.0, 100.0),
              trained("joint_damping_factor"), fixed("joint_damping_factor")),
        Sweep("encoder bias", "+- rad", (0.0, 0.02, 0.04, 0.06, 0.08, 0.1),
              spread("encoder_bias"), around("encoder_bias")),
        Sweep("IMU tilt", "+- rad", (0.0, 0.02, 0.04, 0.06, 0.1), spread("imu_tilt"),
              around("imu_tilt")),
        Sweep("gyro bias", "+- rad/s", (0.0, 0.05, 0.1, 0.2, 0.5), spread("gyro_bias"),
              around("gyro_bias")),
    ]  # fmt: skip


def measure(subject: Subject) -> dict:
    """Return the shares of success by disturbance, value and skill."""
    options = subject.options

    def run(sweep: Sweep, value: float) -> dict:
        config = subject.flat()
        config.sim.solver_iterations = max(config.sim.solver_iterations, SOLVER_ITERATIONS)
        sweep.apply(config.env.randomization, value)
        worlds = options.robots * len(subject.skills)
        env = subject.make_env(config, worlds, DURATION)
        tasks = deal_skills(env, options.command)
        recording = record(env, subject.policy_in(env), DURATION, *tasks)
        robots = per_robot(recording, env)
        stands = robots["falls"] == 0
        keeps = stands.clone()
        for name in ("height", "pitch", "velocity"):
            keeps &= robots[f"{name}_error"] <= getattr(FLOOR, name)
        return {
            skill: {
                "success": keeps[recording.skill == i].float().mean().item(),
                "stands": stands[recording.skill == i].float().mean().item(),
            }
            for i, skill in enumerate(subject.skills)
        }

    def key(sweep: Sweep, value: float) -> str:
        return subject.key(
            "robustness",
            of=sweep.name.replace(" ", "_"),
            value=f"{value:g}",
            robots=options.robots,
            command=options.command,
            solver_iterations=SOLVER_ITERATIONS,
        )

    disturbances = sweeps(replace(subject, options=replace(options, nominal=False)).flat())
    results = subject.results(
        {key(s, value): partial(run, s, value) for s in disturbances for value in s.values}
    )
    return {
        sweep.name: {
            "unit": sweep.unit,
            "trained": list(sweep.trained),
            "cells": {f"{value:g}": results[key(sweep, value)] for value in sweep.values},
        }
        for sweep in disturbances
    }


def section(results: dict[str, dict]) -> Section:
    """Return a table and a curve of each disturbance."""
    names = list(next(iter(results.values())))
    return Section(
        "robustness", TITLE, TEXT, [_table(name, results) for name in names], [_figure(results)]
    )


def _table(name: str, results: dict[str, dict]) -> Table:
    rows, skills = [], []
    for label, values in results.items():
        for value, cells in values[name]["cells"].items():
            skills = list(cells)
            shares = [100 * c["success"] for c in cells.values()]
            stands = 100 * sum(c["stands"] for c in cells.values()) / len(cells)
            rows.append((value, label, *shares, sum(shares) / len(shares), stands))
    first = next(iter(results.values()))[name]
    columns = (
        Column(name, first["unit"]),
        Column("policy"),
        *(Column(skill, "%", "{:.0f}") for skill in skills),
        Column("all", "%", "{:.0f}"),
        Column("did not fall", "%", "{:.0f}"),
    )
    low, high = first["trained"]
    note = f"Training: {low:g} to {high:g} {first['unit']}".rstrip() + "."
    return Table(name.capitalize(), columns, rows, note)


def _figure(results: dict[str, dict]) -> Figure:
    first = next(iter(results.values()))
    drawing, axes = panels(len(first), width=2.7)
    for axis, (name, sweep) in zip(axes, first.items(), strict=True):
        axis.axvspan(*sweep["trained"], color="#2f8f57", alpha=0.12, linewidth=0)
        for (label, values), colour in zip(results.items(), colours(), strict=False):
            cells = values[name]["cells"]
            for kind, style in (("stands", ":"), ("success", "-")):
                means = [100 * sum(c[kind] for c in v.values()) / len(v) for v in cells.values()]
                legend = label if kind == "success" else None
                axis.plot(list(map(float, cells)), means, style, color=colour, label=legend)
        axis.set(xlabel=f"{name} [{sweep['unit'] or 1}]", ylim=(-3, 103))
    axes[0].set_ylabel("robots [%]")
    axes[0].legend(fontsize=7)
    note = "Mean over all skills. Solid: success; dotted: did not fall; shaded: range of training."
    return Figure("Success against disturbances", drawing, note)
