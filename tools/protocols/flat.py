"""Every skill on flat ground: posture, velocity, falls."""

from __future__ import annotations

import math
from dataclasses import asdict

from kiras_rl.evaluation.flat import FLOOR, TARGET, Goal, SkillResult, evaluate_skills
from kiras_rl.tools.protocols.rows import skill_table
from kiras_rl.tools.protocols.subject import Subject
from kiras_rl.tools.report.content import Cell, Column, Section, Table

GOALS = {"target": TARGET, "floor": FLOOR}
"""What a table calls reached, the best first."""

TITLE = "Flat ground"
TEXT = (
    "Every skill walks straight ahead from its keyframe, without action noise, on robots drawn by "
    "the domain randomization, with sensor noise, delay and pushes. Errors of height and pitch are "
    "those of a 0.4 s moving average after the first second; the velocity error is that of each "
    "step."
)

COLUMNS = (
    Column("height", "cm", "{:.1f}"),
    Column("error", "cm", "{:.1f}", best="low"),
    Column("pitch", "deg", "{:+.1f}"),
    Column("error", "deg", "{:.1f}", best="low"),
    Column("v_x", "m/s", "{:+.2f}"),
    Column("error", "m/s", "{:.2f}", best="low"),
    Column("lifts", "1/s"),
    Column("clear", "%", "{:.0f}"),
    Column("duty", "%", "{:.0f}"),
    Column("beyond", "%", "{:.1f}", best="low"),
    Column("motor", "%", "{:.1f}", best="low"),
    Column("power", "W", "{:.1f}", best="low"),
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
    reached = next((name for name, goal in GOALS.items() if result.meets(goal)), "neither")
    return (
        100 * result.height,
        100 * result.height_error,
        math.degrees(result.pitch),
        math.degrees(result.pitch_error),
        result.velocity,
        result.velocity_error,
        f"{result.lifts:.1f}-{result.most_lifts:.1f}",
        100 * result.clearance,
        100 * result.duty,
        100 * result.beyond,
        100 * result.saturated,
        result.power,
        100 * result.falls,
        reached,
    )


def _limits() -> str:
    def words(goal: Goal) -> str:
        return (
            f"errors of at most {100 * goal.height:.0f} cm, {math.degrees(goal.pitch):.0f} "
            f"degrees, {goal.velocity:.2f} m/s, {100 * goal.falls:.0f} % falls; "
            f"{goal.lifts[0]:g} to {goal.lifts[1]:g} lifts per second of every foot, "
            f"{100 * goal.clearance:.0f} % of the robot's own step height; joints beyond their "
            f"limits in {100 * goal.beyond:g} %, a motor at its limit in {100 * goal.saturated:g} %"
        )

    return f"Floor: {words(FLOOR)}. Target: {words(TARGET)}."
