"""Every skill on flat ground: posture, velocity, falls."""

from __future__ import annotations

import math
from dataclasses import asdict

from kiras_rl.evaluation.flat import FLOOR, SkillResult, evaluate_skills
from kiras_rl.tools.protocols.rows import skill_table
from kiras_rl.tools.protocols.subject import Subject
from kiras_rl.tools.report.content import Cell, Column, Section, Table

TITLE = "Flat ground"
TEXT = (
    "Every skill walks straight ahead from its keyframe, without action noise, on robots drawn by "
    "the domain randomization, with sensor noise, delay and pushes. Errors of height and pitch are "
    "those of a 0.4 s moving average after the first second; the velocity error is that of each "
    "step."
)

TARGET = {"height": 0.01, "pitch": math.radians(2.0), "velocity": 0.08, "falls": 0.0}
"""What a skill should reach: m, rad, m/s, share of robots."""

COLUMNS = (
    Column("height", "cm", "{:.1f}"),
    Column("error", "cm", "{:.1f}", best="low"),
    Column("pitch", "deg", "{:+.1f}"),
    Column("error", "deg", "{:.1f}", best="low"),
    Column("v_x", "m/s", "{:+.2f}"),
    Column("error", "m/s", "{:.2f}", best="low"),
    Column("lifts", "1/s", "{:.1f}"),
    Column("falls", "%", "{:.0f}", best="low"),
    Column("reached"),
)


def measure(subject: Subject) -> dict:
    """Return the results by skill."""
    options = subject.options

    def run() -> dict:
        worlds = options.robots * len(subject.skills)
        env = subject.make_env(subject.flat(), worlds, options.duration)
        results = evaluate_skills(env, subject.policy_in(env), options.duration, options.command)
        return {name: asdict(result) for name, result in results.items()}

    key = subject.key(
        "flat", robots=options.robots, duration=options.duration, command=options.command
    )
    return {"skills": subject.results({key: run})[key]}


def section(results: dict[str, dict]) -> Section:
    """Return the table of one or several policies."""
    return Section("flat", TITLE, TEXT, [table({k: v["skills"] for k, v in results.items()})])


def table(results: dict[str, dict[str, dict]], title: str = "Skills on flat ground") -> Table:
    """Return a row a skill, from label -> skill -> fields of SkillResult."""
    return skill_table(title, COLUMNS, results, _cells, _limits())


def _cells(values: dict) -> tuple[Cell, ...]:
    result = SkillResult(**values)
    limits = {"target": TARGET, "floor": FLOOR}
    reached = next((name for name in limits if result.meets(**limits[name])), "neither")
    return (
        100 * result.height,
        100 * result.height_error,
        math.degrees(result.pitch),
        math.degrees(result.pitch_error),
        result.velocity,
        result.velocity_error,
        result.lifts,
        100 * result.falls,
        reached,
    )


def _limits() -> str:
    def words(limits: dict[str, float]) -> str:
        return (
            f"{100 * limits['height']:.0f} cm, {math.degrees(limits['pitch']):.0f} degrees, "
            f"{limits['velocity']:.2f} m/s, {100 * limits['falls']:.0f} % falls"
        )

    return (
        f"Floor: errors of at most {words(FLOOR)}, and every foot lifts once a second; "
        f"target: {words(TARGET)}."
    )
