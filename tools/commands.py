"""Where the installed commands begin: an interrupt is heard while their modules are imported."""

from __future__ import annotations

from importlib import import_module

from kiras_rl.tools.ending import finish


def bench() -> int:
    """Run kiras-bench."""
    return _run("bench")


def collect() -> int:
    """Run kiras-collect."""
    return _run("collect")


def compare() -> int:
    """Run kiras-compare."""
    return _run("compare")


def evaluate() -> int:
    """Run kiras-evaluate."""
    return _run("evaluate")


def export() -> int:
    """Run kiras-export."""
    return _run("export")


def keyframes() -> int:
    """Run kiras-keyframes."""
    return _run("keyframes")


def play() -> int:
    """Run kiras-play."""
    return _run("play")


def terrains() -> int:
    """Run kiras-terrains."""
    return _run("terrains")


def train() -> int:
    """Run kiras-train."""
    return _run("train")


def _run(name: str) -> int:
    def work() -> int:
        import_module("kiras_rl.robots")  # MuJoCo first, whatever graphics there are
        return import_module(f"kiras_rl.tools.{name}").main()

    return finish(work)
