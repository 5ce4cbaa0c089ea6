"""What can be driven here, the shipped policies and those of runs; and on which ground."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

from kiras_rl.deploy.policy import PolicyError
from kiras_rl.robots.robot import ROBOTS, list_robots
from kiras_rl.tools.driving.viewer.cockpit import Cockpit
from kiras_rl.tools.driving.viewer.view import Selector
from kiras_rl.tools.shared.policy_files import CHECKPOINTS, find_policy

RUNS = Path("runs")
"""Where kiras-train puts its runs, seen from the folder in which a command is called."""


@dataclass(frozen=True)
class Choice:
    """A policy: how it is called in a list, and its file or run folder."""

    title: str
    path: Path


def list_choices(runs: Path = RUNS) -> list[Choice]:
    """List shipped policies, robot by robot, then those of runs, the newest first."""
    shipped = [
        Choice(f"{robot}: {path.stem}", path)
        for robot in list_robots()
        for path in sorted((ROBOTS / robot / "policies").glob("*.onnx"))
    ]
    return shipped + [Choice(title_of(run), run) for run in _runs(runs)]


def title_of(source: Path) -> str:
    """Return what a policy is called: the last two parts of its run, or its file's name."""
    source = source.resolve()
    if source.is_dir():
        return f"{source.parent.name}/{source.name}"
    robot = source.parent.parent
    return f"{robot.name}: {source.stem}" if robot.parent == ROBOTS.resolve() else source.name


def newest_checkpoint(run: Path) -> Path | None:
    """Return the checkpoint that a run wrote last, or None before the first.

    Raises:
        PolicyError: If the path is not the folder of one run.
    """
    if not (run / "config.yaml").is_file():
        raise PolicyError(f"only a run can be followed, such as runs/solo8/<time>, not {run}")
    return max(_checkpoints(run), key=lambda path: path.stat().st_mtime_ns, default=None)


def terrain_selectors(cockpit: Cockpit) -> list[Selector]:
    """Return the lists that the ground is chosen from: type, level and variant."""

    def choose(**changes: str | int) -> None:
        cockpit.post(partial(cockpit.choose_tile, **changes))

    def numbered(name: str, count: int) -> list[str]:
        return [f"{name} {number}" for number in range(count)]

    def current(name: str, number: int) -> str:
        return f"no {name}s" if cockpit.tile.is_flat else f"{name} {number}"

    return [
        Selector(
            "terrain",
            heading="Terrain",
            options=lambda: cockpit.terrain.kinds,
            current=lambda: cockpit.tile.kind,
            choose=lambda index: choose(kind=cockpit.terrain.kinds[index]),
            keys="F",
        ),
        Selector(
            "level",
            options=lambda: numbered("level", cockpit.terrain.levels),
            current=lambda: current("level", cockpit.tile.level),
            choose=lambda index: choose(level=index),
            keys="K L",
            share=2,
        ),
        Selector(
            "variant",
            options=lambda: numbered("variant", cockpit.terrain.variants),
            current=lambda: current("variant", cockpit.tile.variant),
            choose=lambda index: choose(variant=index),
            keys="V",
            share=2,
        ),
    ]


def _checkpoints(run: Path) -> list[Path]:
    return [run / name for name in CHECKPOINTS if (run / name).is_file()]


def _runs(folder: Path) -> list[Path]:
    runs = [path.parent for path in folder.glob("*/*/config.yaml") if _has_policy(path.parent)]
    return sorted(runs, key=lambda run: run.name, reverse=True)


def _has_policy(run: Path) -> bool:
    try:
        find_policy(run)
    except PolicyError:
        return False
    return True
