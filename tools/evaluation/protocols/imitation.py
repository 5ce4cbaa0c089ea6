"""How closely the keyframes are kept, and what the gait is like."""

from __future__ import annotations

import math
from collections.abc import Callable

from kiras_rl.evaluation.flat import SETTLE
from kiras_rl.evaluation.imitation import STEPS, evaluate_imitation
from kiras_rl.tools.evaluation.protocols.rows import scaled, skill_table
from kiras_rl.tools.evaluation.protocols.subject import Subject
from kiras_rl.tools.evaluation.report.content import Cell, Column, Section, Table

TITLE = "Imitation"
TEXT = (
    "Every skill walks straight ahead without pushes; of the 120 steps after the first second: "
    "distance by dynamic time warping and cosine to the keyframe, errors of height and pitch, "
    "the nearest keyframe, feet, torques and power. Definitions: docs/metrics.md."
)

PAPER = {
    "walk": (15.67, 0.978),
    "stilt": (15.19, 0.974),
    "crawl": (20.11, 0.987),
    "pitch_up": (18.03, 0.965),
    "pitch_down": (19.04, 0.976),
}
"""DTW and cosine of KiRAS against the keyframes, arXiv 2603.15179. Features and weights are not
given there, so that only their order can be compared."""

NOTE = (
    "Raw cosines are near 1 for any two poses; the centred one is not, but says little of a skill "
    "whose keyframe is near the mean of all."
)

POSTURE = (
    Column("DTW", form="{:.1f}", best="low"),
    Column("± robots", form="{:.1f}"),
    Column("a frame", form="{:.3f}", best="low"),
    Column("cosine", form="{:.3f}"),
    Column("centred cosine", form="{:.3f}", best="high"),
    Column("height error", "cm", "{:.1f}", best="low"),
    Column("pitch error", "deg", "{:.1f}", best="low"),
    Column("falls", "%", "{:.0f}", best="low"),
)
GAIT = (
    Column("v_x", "m/s", "{:+.2f}"),
    Column("clearance", "cm", "{:.1f}"),
    Column("frequency", "1/s", "{:.1f}"),
    Column("duty", "%", "{:.0f}"),
    Column("torque", "N m", "{:.2f}"),
    Column("peak torque", "N m", "{:.2f}"),
    Column("power", "W", "{:.1f}"),
    Column("cost of transport", form="{:.2f}"),
)


def measure(subject: Subject) -> dict:
    """Return the results by skill and the confusion of keyframes."""
    key, run = piece(subject)
    return subject.results({key: run})[key]


def piece(subject: Subject) -> tuple[str, Callable[[], dict]]:
    """Return the key of the results, and what measures them."""
    options = subject.options

    def run() -> dict:
        config = subject.flat()
        config.env.randomization.push_velocity = None
        duration = SETTLE + STEPS * config.sim.timestep * config.sim.substeps
        worlds = options.robots * len(subject.skills)
        env = subject.make_env(config, worlds, duration)
        return evaluate_imitation(env, subject.policy_in(env), options.command).as_dict()

    key = subject.key("imitation", robots=options.robots, command=options.command)
    return key, run


def section(results: dict[str, dict]) -> Section:
    """Return tables of postures, gaits and nearest keyframes."""
    skills = {label: values["skills"] for label, values in results.items()}
    tables = [
        skill_table("Distance to the keyframes", POSTURE, skills, _posture, NOTE),
        _paper(),
        skill_table("Gait", GAIT, skills, _gait),
        *(_nearest(label, values) for label, values in results.items()),
    ]
    return Section("imitation", TITLE, TEXT, tables)


def _paper() -> Table:
    rows = [(name, *values) for name, values in PAPER.items()]
    columns = (Column("skill"), Column("DTW"), Column("cosine", form="{:.3f}"))
    note = "The paper does not say how its features are weighed: only the order can be compared."
    return Table("The paper's values", columns, rows, note)


def _posture(r: dict) -> tuple[Cell, ...]:
    return (
        r["dtw"],
        r["dtw_std"],
        r["dtw_frame"],
        r["cosine"],
        r["centred_cosine"],
        scaled(r["height_error"], 100),
        scaled(r["pitch_error"], 180 / math.pi),
        scaled(r["falls"], 100),
    )


def _gait(r: dict) -> tuple[Cell, ...]:
    return (
        r["velocity"],
        scaled(r["clearance"], 100),
        r["frequency"],
        scaled(r["duty"], 100),
        r["torque"],
        r["peak_torque"],
        r["power"],
        r["cost_of_transport"],
    )


def _nearest(label: str, values: dict) -> Table:
    names = list(values["skills"])
    rows = [
        (name, *(scaled(share, 100) for share in shares))
        for name, shares in zip(names, values["confusion"], strict=True)
    ]
    columns = (Column("skill"), *(Column(name, "%", "{:.0f}") for name in names))
    return Table(f"Nearest keyframe: {label}", columns, rows, "Share of the steps of a skill.")
