"""Where the installed commands begin: an interrupt is heard while their modules are imported."""

from __future__ import annotations

from importlib import import_module

from kiras_rl.tools.shared.ending import finish


def bench(argv: list[str] | None = None) -> int:
    """Run kiras-bench; return its exit status."""
    return _run("bench", argv)


def collect(argv: list[str] | None = None) -> int:
    """Run kiras-collect; return its exit status."""
    return _run("collect", argv)


def compare(argv: list[str] | None = None) -> int:
    """Run kiras-compare; return its exit status."""
    return _run("compare", argv)


def evaluate(argv: list[str] | None = None) -> int:
    """Run kiras-evaluate; return its exit status."""
    return _run("evaluate", argv)


def export(argv: list[str] | None = None) -> int:
    """Run kiras-export; return its exit status."""
    return _run("export", argv)


def keyframes(argv: list[str] | None = None) -> int:
    """Run kiras-keyframes; return its exit status."""
    return _run("keyframes", argv)


def play(argv: list[str] | None = None) -> int:
    """Run kiras-play; return its exit status."""
    return _run("play", argv)


def terrains(argv: list[str] | None = None) -> int:
    """Run kiras-terrains; return its exit status."""
    return _run("terrains", argv)


def train(argv: list[str] | None = None) -> int:
    """Run kiras-train; return its exit status."""
    return _run("train", argv)


def _run(name: str, argv: list[str] | None) -> int:
    def work() -> int:
        import_module("kiras_rl.robots")  # MuJoCo first, whatever graphics there are
        return import_module(f"kiras_rl.tools.{name}").main(argv)

    return finish(work)
