"""One disturbance at a time, beyond what training had: where the policy breaks."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from kiras_rl.evaluation.flat import FLOOR, deal_skills, per_robot, record
from kiras_rl.schema import Config, RandomizationConfig
from kiras_rl.tools.protocols.rows import colours, panels
from kiras_rl.tools.protocols.subject import Subject
from kiras_rl.tools.report.content import Column, Figure, Section, Table

TITLE = "Robustness"
TEXT = (
    "Every skill walks straight ahead for 10 s on flat ground while one disturbance is set to a "
    "value and all others are drawn as in training. Pushes come about every 5 s, each axis up to "
    "the value. A robot succeeds if it does not fall and its "
    f"errors stay at the floor's: {100 * FLOOR.height:.0f} cm, "
    f"{math.degrees(FLOOR.pitch):.0f} degrees, {FLOOR.velocity:.2f} m/s."
)

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
    apply: Callable[[RandomizationConfig, float], None]


def sweeps(config: Config) -> list[Sweep]:
    """Return the sweeps; sizes follow the robot's own randomization."""
    drawn, step = config.env.randomization, 1000.0 * config.sim.timestep
    push, payload = drawn.push_velocity[1], drawn.payload[1]

    def set_push(r: RandomizationConfig, value: float) -> None:
        r.push_velocity = (-value, value)

    def set_delay(r: RandomizationConfig, value: float) -> None:
        r.action_delay = (round(value / step), round(value / step))

    def setter(name: str) -> Callable[[RandomizationConfig, float], None]:
        return lambda r, value: setattr(r, name, (value, value))

    return [
        Sweep(
            "push", "m/s", tuple(push * k for k in (0, 1, 2, 4, 6, 8, 10)), (0.0, push), set_push
        ),
        Sweep(
            "payload",
            "kg",
            tuple(payload * k for k in (-2, 0, 1, 2, 3, 4, 6)),
            drawn.payload,
            setter("payload"),
        ),
        Sweep(
            "friction",
            "",
            (1.25, 0.8, 0.5, 0.2, 0.1, 0.05, 0.02),
            drawn.friction,
            setter("friction"),
        ),
        Sweep(
            "delay",
            "ms",
            tuple(step * k for k in (0, 2, 3, 4, 5, 6, 8)),
            tuple(step * k for k in drawn.action_delay),
            set_delay,
        ),
        Sweep(
            "torque limit",
            "of the motor's",
            (1.2, 1.0, 0.8, 0.6, 0.5, 0.4, 0.3),
            drawn.torque_factor or (1.0, 1.0),
            setter("torque_factor"),
        ),
    ]


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
