"""Every ordered pair of skills, on flat and on rough ground."""

from __future__ import annotations

import math
from dataclasses import asdict, replace

import torch

from kiras_rl.config import ConfigError
from kiras_rl.envs.quadruped import QuadrupedEnv
from kiras_rl.evaluation.transitions import AFTER, BEFORE, evaluate_transitions, trace_skills
from kiras_rl.schema import Config
from kiras_rl.tools.evaluation.protocols.rows import colours, panels, scaled
from kiras_rl.tools.evaluation.protocols.subject import Subject
from kiras_rl.tools.evaluation.report.content import Cell, Column, Figure, Section, Table

TITLE = "Transitions"
TEXT = (
    "Every ordered pair of skills, switched while walking after 2 s: falls, and the time until the "
    "moving averages of height (1.5 cm) and pitch (3 degrees) stay at the new keyframe for 0.3 s; "
    "a robot that was not in the first skill before the switch counts as not settled. Rough: on "
    "all rough terrain types in turn, up and down, level 3 of 0 to 9."
)

TRIALS = 50  # of a pair
ROUGH_LEVELS, ROUGH_LEVEL = 10, 3
VARIANTS = 4  # of a tile; every second one leads the other way
HOLD = 3.0  # s of each skill in the traces
TRACE_ROBOTS = 20

OVERALL = (
    Column("settled within 2 s", "%", "{:.1f}", best="high"),
    Column("settle time", "s", best="low"),
    Column("falls", "%", "{:.1f}", best="low"),
    Column("overshoot, height", "cm", "{:.1f}", best="low"),
    Column("overshoot, pitch", "deg", "{:.1f}", best="low"),
    Column("velocity error", "m/s", best="low"),
    Column("jerk", "of before", "{:.1f}", best="low"),
    Column("action rate", "of before", "{:.1f}", best="low"),
)
_FACTORS = (100, 1, 100, 100, 180 / math.pi, 1, 1, 1)
_FIELDS = (
    "settled",
    "settle_time",
    "fell",
    "height_overshoot",
    "pitch_overshoot",
    "velocity_error",
    "jerk",
    "action_rate",
)


def is_known(subject: Subject) -> bool:
    """Tell whether there are pairs of skills."""
    return len(subject.skills) > 1


def measure(subject: Subject) -> dict:
    """Return the pairs on both grounds and a trace through all skills on flat ground.

    Raises:
        ConfigError: A policy of one skill.
    """
    if not is_known(subject):
        raise ConfigError(
            f"transitions are between two skills, and {subject.label} has {subject.skills[0]} "
            "alone: name other protocols with --protocol"
        )
    options = subject.options
    trials = options.trials_or(TRIALS)
    keep = {"trials": trials, "command": options.command}

    def pairs(config: Config, rough: bool) -> dict:
        worlds = len(subject.skills) * (len(subject.skills) - 1) * trials
        env = subject.make_env(config, worlds, BEFORE + AFTER)
        if rough:
            env.place(*_rough_tiles(env))
        result = asdict(evaluate_transitions(env, subject.policy_in(env), trials, options.command))
        return {
            name: [[_plain(x) for x in row] for row in value.tolist()]
            for name, value in result.items()
            if name != "trials"
        }

    def trace() -> dict:
        order = [*range(len(subject.skills)), 0]
        env = subject.make_env(subject.flat(), TRACE_ROBOTS, HOLD * len(order))
        height, pitch = trace_skills(env, subject.policy_in(env), order, HOLD, options.command)
        curves = {
            name: {
                "mean": x.mean(1).tolist(),
                "low": x.amin(1).tolist(),
                "high": x.amax(1).tolist(),
            }
            for name, x in (("height", height), ("pitch", pitch))
            if x.shape[1]
        }
        goals = {"height": env.keyframe_height[order], "pitch": env.keyframe_pitch[order]}
        return {
            "order": [subject.skills[i] for i in order],
            "dt": env.step_dt,
            "goal": {name: goal.tolist() for name, goal in goals.items()},
            **curves,
        }

    pieces = {
        subject.key("transitions/flat", **keep): lambda: pairs(subject.flat(), rough=False),
        subject.key("transitions/rough", **keep): lambda: pairs(_rough(subject), rough=True),
        subject.key("transitions/trace", command=options.command): trace,
    }
    results = zip(("flat", "rough", "trace"), subject.results(pieces).values(), strict=True)
    return {"skills": list(subject.skills), **dict(results)}


def _rough(subject: Subject) -> Config:
    config = subject.rough()
    config.env.terrain = replace(subject.terrain, levels=ROUGH_LEVELS, variants=VARIANTS)
    return config


def _rough_tiles(env: QuadrupedEnv) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return types, levels and variants, (N,) each: every variant of every rough type in turn."""
    kinds = torch.tensor([i for i, name in enumerate(env.terrains) if name != "flat"])
    world = torch.arange(env.num_envs)
    kind, variant = kinds[world % len(kinds)], world // len(kinds) % VARIANTS
    level = torch.full_like(world, ROUGH_LEVEL)
    return kind.to(env.device), level.to(env.device), variant.to(env.device)


def section(results: dict[str, dict]) -> Section:
    """Return overall values, a matrix of pairs for each policy, and the traces."""
    rows = [
        (ground, label, *_overall(values[ground]))
        for ground in ("flat", "rough")
        for label, values in results.items()
    ]
    overall = Table("All pairs", (Column("ground"), Column("policy"), *OVERALL), rows, _NOTE)
    pairs = [
        _pairs(f"{ground.capitalize()} ground: {label}", values["skills"], values[ground])
        for label, values in results.items()
        for ground in ("flat", "rough")
    ]
    return Section("transitions", TITLE, TEXT, [overall, *pairs], [_traces(results)])


_NOTE = (
    "Jerk (second difference of the base velocity) and action rate: the largest in the half second "
    "after the switch over the largest in the half second before; 1 is as smooth as walking on."
)


def _plain(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _overall(values: dict) -> list[Cell]:
    cells: list[Cell] = []
    for name, factor in zip(_FIELDS, _FACTORS, strict=True):
        known = [x for row in values[name] for x in row if x is not None]
        cells.append(scaled(sum(known) / len(known), factor) if known else None)
    return cells


def _pairs(title: str, skills: list[str], values: dict) -> Table:
    def cell(i: int, j: int) -> str:
        settled, time, fell = (values[name][i][j] for name in ("settled", "settle_time", "fell"))
        if settled is None:
            return ""
        falls = f", {100 * fell:.0f} % fell" if fell else ""
        seconds = "" if time is None else f" in {time:.2f} s"
        return f"{100 * settled:.0f} %{seconds}{falls}"

    rows = [(skill, *(cell(i, j) for j in range(len(skills)))) for i, skill in enumerate(skills)]
    columns = (Column("from / to"), *map(Column, skills))
    return Table(title, columns, rows, "Share that settled within 2 s, and their mean time.")


def _traces(results: dict[str, dict]) -> Figure:
    drawing, axes = panels(2, width=5.2, height=3.2, share=False)
    quantities = (("height", 100.0, "base height [cm]"), ("pitch", 180 / math.pi, "pitch [deg]"))
    for axis, (name, factor, label) in zip(axes, quantities, strict=True):
        for (policy, values), colour in zip(results.items(), colours(), strict=False):
            trace = values["trace"]
            if name not in trace:
                continue  # every robot fell
            time = [i * trace["dt"] for i in range(len(trace[name]["mean"]))]
            low, high, mean = (
                [factor * x for x in trace[name][kind]] for kind in ("low", "high", "mean")
            )
            axis.fill_between(time, low, high, color=colour, alpha=0.15, linewidth=0)
            axis.plot(time, mean, color=colour, linewidth=1.2, label=policy)
        for k, (skill, goal) in enumerate(zip(trace["order"], trace["goal"][name], strict=True)):
            axis.plot([k * HOLD, (k + 1) * HOLD], [factor * goal] * 2, "k:", linewidth=1)
            axis.text((k + 0.5) * HOLD, 1.01, skill, transform=axis.get_xaxis_transform(),
                      ha="center", fontsize=7)  # fmt: skip
        axis.set(xlabel="time [s]", ylabel=label)
    if len(results) > 1:
        axes[0].legend(fontsize=8)
    note = f"{TRACE_ROBOTS} robots, mean and range of those that never fell; dotted: the keyframes."
    return Figure("Height and pitch through all skills", drawing, note)
