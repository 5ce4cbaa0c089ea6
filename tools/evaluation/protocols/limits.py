"""How near a policy takes joints and motors to what the robot allows."""

from __future__ import annotations

from kiras_rl.evaluation.limits import as_dict, evaluate_limits
from kiras_rl.tools.evaluation.protocols.rows import scaled, skill_table
from kiras_rl.tools.evaluation.protocols.subject import Subject
from kiras_rl.tools.evaluation.report.content import Cell, Column, Section, Table

TITLE = "Limits"
TEXT = (
    "Every skill walks on flat ground for 10 s, each robot by a command of its own: they fill the "
    "ranges of forward, lateral and turning velocity. Robots, noise, delay and pushes are those "
    "of the flat protocol; the first second does not count. Joint and speed limits, and the "
    "torques that motors may give, are those of the robot's robot.yaml."
)

DURATION = 10.0  # s

COLUMNS = (
    Column("beyond joint limits", "%", "{:.2f}", best="low"),
    Column("least margin", "rad", "{:+.3f}", best="high"),
    Column("too fast", "%", "{:.2f}", best="low"),
    Column("peak speed", "% of limit", "{:.0f}", best="low"),
    Column("motor at its limit", "%", "{:.2f}", best="low"),
    Column("peak torque", "% of limit", "{:.0f}", best="low"),
    Column("power", "W", "{:.1f}", best="low"),
    Column("peak power", "W", "{:.0f}", best="low"),
    Column("falls", "%", "{:.0f}", best="low"),
)


def measure(subject: Subject) -> dict:
    """Return the results by skill."""
    options = subject.options

    def run() -> dict:
        config = subject.flat()
        commands = config.env.commands
        ranges = (commands.lin_vel_x, commands.lin_vel_y, commands.ang_vel_z)
        worlds = options.robots * len(subject.skills)
        env = subject.make_env(config, worlds, DURATION)
        return as_dict(evaluate_limits(env, subject.policy_in(env), ranges, DURATION))

    key = subject.key("limits", robots=options.robots, duration=DURATION)
    return {"skills": subject.results({key: run})[key]}


def section(results: dict[str, dict]) -> Section:
    """Return the table of one or several policies."""
    skills = {label: values["skills"] for label, values in results.items()}
    note = "Of control steps, but the motors' share, which is of physics steps."
    return Section("limits", TITLE, TEXT, [_table(skills, note)])


def _table(skills: dict[str, dict], note: str) -> Table:
    return skill_table("Joints and motors", COLUMNS, skills, _cells, note)


def _cells(r: dict) -> tuple[Cell, ...]:
    return (
        scaled(r["beyond"], 100),
        r["margin"],
        scaled(r["speeding"], 100),
        scaled(r["speed"], 100),
        scaled(r["saturated"], 100),
        scaled(r["torque"], 100),
        r["power"],
        r["peak_power"],
        scaled(r["falls"], 100),
    )
