"""Every skill on flat ground: posture, velocity, falls."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict

from kiras_rl.evaluation.flat import FLOOR, TARGET, Goal, SkillResult, evaluate_skills
from kiras_rl.tools.evaluation.protocols.rows import skill_table
from kiras_rl.tools.evaluation.protocols.subject import Subject
from kiras_rl.tools.evaluation.report.content import Cell, Column, Section, Table

GOALS = {"target": TARGET, "floor": FLOOR}
"""What a table calls reached, the best first."""

TITLE = "Flat ground"
TEXT = (
    "Every skill walks straight ahead from its keyframe, without action noise, on robots drawn by "
    "the domain randomization, with sensor noise, delay and pushes. Errors of height and pitch are "
    "those of a 0.4 s moving average after the first second; the velocity error is that of each "
    "step."
)

POSTURE = (
    Column("height", "cm", "{:.1f}"),
    Column("error", "cm", "{:.1f}", best="low"),
    Column("pitch", "deg", "{:+.1f}"),
    Column("error", "deg", "{:.1f}", best="low"),
    Column("v_x", "m/s", "{:+.2f}"),
    Column("error", "m/s", "{:.2f}", best="low"),
    Column("falls", "%", "{:.0f}", best="low"),
    Column("reached"),
)
GAIT = (
    Column("lifts", "1/s, least", "{:.1f}"),
    Column("lifts", "1/s, most", "{:.1f}"),
    Column("clearance", "% of its own", "{:.0f}"),
    Column("duty", "%", "{:.0f}"),
    Column("beyond joint limits", "%", "{:.1f}", best="low"),
    Column("motor at its limit", "%", "{:.1f}", best="low"),
    Column("power", "W", "{:.1f}", best="low"),
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
    """Return the tables of one or several policies."""
    return Section("flat", TITLE, TEXT, tables({k: v["skills"] for k, v in results.items()}))


def tables(
    results: dict[str, dict[str, dict]], title: str = "Skills on flat ground"
) -> list[Table]:
    """Return posture and gait, a row a skill, from label -> skill -> fields of SkillResult."""
    return [
        skill_table(title, POSTURE, results, _posture, _goals(_posture_words)),
        skill_table("Gait and limits", GAIT, results, _gait, _goals(_gait_words)),
    ]


def _posture(values: dict) -> tuple[Cell, ...]:
    result = SkillResult(**values)
    reached = next((name for name, goal in GOALS.items() if result.meets(goal)), "neither")
    return (
        100 * result.height,
        100 * result.height_error,
        math.degrees(result.pitch),
        math.degrees(result.pitch_error),
        result.velocity,
        result.velocity_error,
        100 * result.falls,
        reached,
    )


def _gait(values: dict) -> tuple[Cell, ...]:
    result = SkillResult(**values)
    return (
        result.lifts,
        result.most_lifts,
        100 * result.clearance,
        100 * result.duty,
        100 * result.beyond,
        100 * result.saturated,
        result.power,
    )


def _goals(words: Callable[[Goal], str]) -> str:
    return f"Floor: {words(FLOOR)}; target: {words(TARGET)}. Both take both tables."


def _posture_words(goal: Goal) -> str:
    return (
        f"errors of at most {100 * goal.height:.0f} cm, {math.degrees(goal.pitch):.0f} degrees, "
        f"{goal.velocity:.2f} m/s, {100 * goal.falls:.0f} % falls"
    )


def _gait_words(goal: Goal) -> str:
    return (
        f"{goal.lifts[0]:g} to {goal.lifts[1]:g} lifts per second, a clearance of "
        f"{100 * goal.clearance:.0f} % at least, {100 * goal.beyond:g} % beyond joint limits and "
        f"{100 * goal.saturated:g} % at a motor's limit at most"
    )
