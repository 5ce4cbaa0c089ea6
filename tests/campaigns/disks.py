"""Let the disk of a command be full at a random byte, and see what is said and what is left.

PYTHONPATH=tests python -m campaigns.disks [DISKS [SEED]]

Every command writes to a file system in memory that is smaller than what it writes. It has to end
in one line, with no part of an output in its place. A training has to leave a whole checkpoint or
none; given room, it goes on and ends with the bits of one that had room from the begin. Mounting
takes root, or `unshare --map-root-user --mount` before the command.
"""

from __future__ import annotations

import io
import random
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from importlib import import_module
from pathlib import Path

from campaigns.trainings import differences, latest, train

from kiras_rl.checkpoint import load_checkpoint
from kiras_rl.robots.robot import ROBOTS

_POLICY = str(ROBOTS / "solo8" / "policies" / "flat.onnx")
_ROOM = 64 << 20  # bytes
_PAGE = 4096  # bytes, of which a file system in memory gives whole ones alone


@contextmanager
def disk(folder: Path, size: int) -> Iterator[None]:
    """Have a file system of so many bytes in a folder."""
    folder.mkdir(exist_ok=True)
    _call("mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder))
    try:
        yield
    finally:
        _call("umount", str(folder))


def grow(folder: Path, size: int) -> None:
    """Give the file system in a folder another size, bytes."""
    _call("mount", "-o", f"remount,size={size}", str(folder))


def _call(*command: str) -> None:
    subprocess.run(command, check=True)


def written(folder: Path) -> int:
    """Return how many bytes the files in a folder take."""
    return sum(-(-path.stat().st_size // _PAGE) * _PAGE for path in folder.rglob("*"))


# --- commands that write once --------------------------------------------------------------------


def commands(place: Path, checkpoint: Path) -> dict[str, list[str]]:
    """Return what is tried, by the module of the command, with an output in a place."""
    return {
        "export": [str(checkpoint), "--out", str(place / "policy.onnx")],
        "collect": [_POLICY, "--episodes", "1", "--duration", "1", "--out", str(place / "data")],
        "play": [_POLICY, "--script", "walk:1:0.3", "--trace", str(place / "trace.png")],
        "bench": ["--parts", "inference", "--rounds", "1", "--worlds", "16", "--out", str(place)],
    }


def call(name: str, arguments: list[str]) -> tuple[int, str]:
    """Call a command; return its exit status and what it said of its end."""
    said = io.StringIO()
    with redirect_stdout(io.StringIO()), redirect_stderr(said):
        status = import_module(f"kiras_rl.tools.{name}").main(arguments)
    return status, said.getvalue()


def wrong_end(status: int, said: str) -> str | None:
    """Return what is wrong with how a command ended, None if nothing is."""
    if status == 2 and said.startswith("error: ") and said.count("\n") == 1:
        return None
    return f"status {status}, {said!r}"


def try_command(name: str, arguments: list[str], place: Path, size: int) -> list[str]:
    """Let a command write to too small a disk; return the faults."""
    with disk(place, size):
        try:
            problem = wrong_end(*call(name, arguments))
        except Exception as error:
            problem = f"{type(error).__name__}: {error}"
        left = [str(path.relative_to(place)) for path in place.rglob("*") if path.is_file()]
    return [f"{name}, {size} bytes: {x}" for x in (problem, left and f"left {left}") if x]


# --- trainings -----------------------------------------------------------------------------------


def try_training(whole: Path, place: Path, output: Path, size: int) -> list[str]:
    """Let a training run on too small a disk, then on one with room; return the faults."""
    with disk(place, size):
        problem = wrong_end(train(place, output), _said(output))
        saved = latest(place)
        if saved:
            load_checkpoint(saved)
        grow(place, _ROOM)
        if status := train(place, output):
            return [f"training, {size} bytes: going on ends with {status}: {output.read_text()}"]
        mine, other = latest(place), latest(whole)
        assert mine and other
        found = [*([problem] if problem else []), *differences(mine, other)]
    return [f"training, {size} bytes: {x}" for x in found]


def _said(output: Path) -> str:
    """Return the lines about mistakes, or all where there is a traceback."""
    text = output.read_text()
    if "Traceback" in text:
        return text
    return "".join(line for line in text.splitlines(True) if line.startswith("error: "))


def campaign(disks: int, seed: int = 0) -> list[str]:
    """Try as many disks, a third of them with trainings; return the faults."""
    rng, faults = random.Random(seed), []
    with tempfile.TemporaryDirectory() as folder:
        whole, place, output = (Path(folder, name) for name in ("whole", "disk", "output.txt"))
        if status := train(whole, output):
            return [f"a training with room ends with {status}: {output.read_text()}"]
        saved = latest(whole)
        assert saved
        once = commands(place, saved)
        sizes = {name: _measure(name, once[name], place) for name in once}
        for number in range(disks):
            if number % 3 == 0:
                size = _draw(rng, written(whole))
                faults += try_training(whole, place, output, size)
            else:
                name = rng.choice(list(once))
                faults += try_command(name, once[name], place, _draw(rng, sizes[name]))
    return faults


def _measure(name: str, arguments: list[str], place: Path) -> int:
    """Return how many bytes a command writes where it has room."""
    with disk(place, _ROOM):
        status, said = call(name, arguments)
        if status:
            raise RuntimeError(f"{name} ends with {status}: {said}")
        return written(place)


def _draw(rng: random.Random, size: int) -> int:
    """Return a size in whole pages, at least one page smaller than another one, bytes."""
    return _PAGE * rng.randrange(1, max(2, size // _PAGE))


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 60
    found = campaign(count, int(sys.argv[2]) if len(sys.argv) > 2 else 0)
    sys.stdout.write("\n".join([*found, f"{count} full disks, {len(found)} faults\n"]))
    sys.exit(bool(found))
