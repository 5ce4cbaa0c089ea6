"""Slopes, and stairs up and down, each skill by itself: the paper's hardware table as curves."""

from __future__ import annotations

from functools import cache, partial

from kiras_rl.envs.quadruped import QuadrupedEnv
from kiras_rl.evaluation.terrain import TIME_LIMIT, Obstacle
from kiras_rl.tools.evaluation.protocols.crossing import KINDS_NOTE, count, share, shares
from kiras_rl.tools.evaluation.protocols.rows import colours, panels
from kiras_rl.tools.evaluation.protocols.subject import Subject
from kiras_rl.tools.evaluation.report.content import Column, Figure, Section, Table

TITLE = "Slopes and stairs"
TEXT = (
    "Smooth slopes of 15, 25, 35 and 45 degrees, up, and stairs of 5, 8, 10 and 15 cm, up and down "
    "(times the scale of the robot's terrain), crossed as in the protocol terrain."
)

TRIALS = 200  # of a cell
STEPS = (5, 8, 10, 15)  # cm
ANGLES = (15, 25, 35, 45)  # degrees
UP = 0  # variant: every second slope leads down

COURSES = {
    "slope up": [(angle, Obstacle("slopes", (angle - 5) // 10 - 1, UP)) for angle in ANGLES],
    "stairs up": [(step, Obstacle("stairs_up", step - 5)) for step in STEPS],
    "stairs down": [(step, Obstacle("stairs_down", step - 5)) for step in STEPS],
}
"""Course -> sizes and tiles. The terrain has levels of a centimetre, and of 10 degrees."""

UNITS = {"slope up": "deg", "stairs up": "cm", "stairs down": "cm"}

PAPER = {
    "slope up, 45 degrees": (0.84, 0.68, 0.80, 0.70, 0.90),
    "stairs up, 15 cm": (0.80, 0.54, 0.44, 0.88, 0.58),
    "stairs down, 15 cm": (0.88, 0.46, 0.70, 0.94, 0.56),
}
"""Success of Solo-8 on hardware, 50 trials, arXiv 2603.15179."""
PAPER_SKILLS = ("walk", "crawl", "stilt", "pitch_up", "pitch_down")


def measure(subject: Subject) -> dict:
    """Return the counts of each course, size and skill."""
    trials = subject.options.trials_or(TRIALS)

    @cache
    def build(terrain: str) -> QuadrupedEnv:
        return _build(subject, terrain, trials * len(STEPS))

    def counts(course: str) -> dict:
        sizes, obstacles = zip(*COURSES[course], strict=True)
        cells = count(build(obstacles[0].terrain), subject, list(obstacles), trials)
        return dict(zip(map(str, sizes), cells, strict=True))

    keys = {
        course: subject.key("obstacles", course=course.replace(" ", "_"), trials=trials)
        for course in COURSES
    }
    results = subject.results({key: partial(counts, course) for course, key in keys.items()})
    return {
        "scale": subject.terrain.scale,
        "courses": {course: results[key] for course, key in keys.items()},
    }


def _build(subject: Subject, terrain: str, trials: int) -> QuadrupedEnv:
    config, ground = subject.rough(), subject.terrain
    ground.noise, ground.variants = (0.0, 0.0), 2
    if terrain == "slopes":
        ground.levels = len(ANGLES)
        ground.types = {"slopes": {"proportion": 1.0, "angle": [ANGLES[0], ANGLES[-1]]}}
    else:
        ground.levels = STEPS[-1] - STEPS[0] + 1
        risers = [STEPS[0] / 100, STEPS[-1] / 100]
        ground.types = {terrain: {"proportion": 1.0, "riser": risers, "tread": 0.3}}
    config.env.terrain = ground
    worlds = trials * len(subject.skills)
    return subject.make_env(config, worlds, TIME_LIMIT)


def section(results: dict[str, dict]) -> Section:
    """Return tables and curves, with the paper's table beside."""
    tables = [_table(course, results) for course in COURSES]
    figures = [_figure(label, values) for label, values in results.items()]
    return Section("obstacles", TITLE, TEXT, [*tables, _paper()], figures)


def _table(course: str, results: dict[str, dict]) -> Table:
    rows, skills = [], []
    for label, values in results.items():
        for size, cells in values["courses"][course].items():
            skills = list(cells)
            texts = map(shares, cells.values())
            rows.append((_size(course, size, values["scale"]), label, *texts))
    columns = (Column("size"), Column("policy"), *map(Column, skills))
    return Table(course.capitalize(), columns, rows, KINDS_NOTE)


def _size(course: str, size: str, scale: float) -> str:
    if UNITS[course] == "deg":
        return f"{size} degrees"
    return f"{scale * int(size):g} cm"


def _paper() -> Table:
    rows = [(name, *(100 * x for x in shares)) for name, shares in PAPER.items()]
    columns = (Column("obstacle"), *(Column(name, "%", "{:.0f}") for name in PAPER_SKILLS))
    note = (
        "On the robot, 50 trials a cell. There friction, motors and shells differ from the "
        "simulation's: what can be compared is the order of the skills."
    )
    return Table("The paper's hardware", columns, rows, note)


def _figure(label: str, values: dict) -> Figure:
    drawing, axes = panels(len(COURSES))
    for axis, (course, sizes) in zip(axes, values["courses"].items(), strict=True):
        skills = list(next(iter(sizes.values())))
        unit = UNITS[course]
        scale = 1.0 if unit == "deg" else values["scale"]
        for skill, colour in zip(skills, colours(), strict=False):
            points = [scale * int(size) for size in sizes]
            for kind, style in (("success", "--"), ("feet_only", "-")):
                percents = [100 * share(cells[skill], kind) for cells in sizes.values()]
                name = skill if kind == "feet_only" else None
                axis.plot(points, percents, style, color=colour, label=name, marker="o", ms=3)
        axis.set(title=course, xlabel=f"[{unit}]", ylim=(-3, 103))
    axes[0].set_ylabel("success [%]")
    axes[-1].legend(fontsize=7)
    return Figure(f"Slopes and stairs: {label}", drawing, "Dashed: success; solid: on feet only.")
