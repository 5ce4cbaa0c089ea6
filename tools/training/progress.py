"""One line that says how far a training is, how long it still takes, and whether it learns."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Iterator

from rich.console import Console
from rich.live import Live
from rich.text import Text

from kiras_rl.evaluation.flat import SkillResult
from kiras_rl.evaluation.terrain import TerrainResult
from kiras_rl.status import Status

PLAIN_INTERVAL = 30.0  # s between lines where the output is not a terminal
WINDOW = 40  # iterations over which the pace is averaged


class Progress:
    """Redraws one line on a terminal; elsewhere prints it now and then."""

    def __init__(self, console: Console) -> None:
        """Write to `console`."""
        self._console = console
        self._live = Live(console=console, refresh_per_second=2) if console.is_terminal else None
        self._shown = time.monotonic()
        self._ends = deque([self._shown], maxlen=WINDOW + 1)

    def __enter__(self) -> Progress:
        """Start the live line."""
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the last line on the screen."""
        if self._live:
            self._live.stop()

    def show(self, status: Status) -> None:
        """Show the state after an iteration."""
        self._ends.append(time.monotonic())
        if self._live:
            self._live.update(Text(self._line(status), no_wrap=True, overflow="ellipsis"))
        elif self._is_due(status):
            self._shown = time.monotonic()
            self._console.print(self._line(status), highlight=False, markup=False, soft_wrap=True)

    def _is_due(self, status: Status) -> bool:
        is_last = status.iteration == status.iterations
        return is_last or len(self._ends) == 2 or time.monotonic() - self._shown > PLAIN_INTERVAL

    def _line(self, status: Status) -> str:
        # Wall time, so that evaluations and checkpoints count: the time left is honest.
        pace = (self._ends[-1] - self._ends[0]) / (len(self._ends) - 1)
        left = pace * (status.iterations - status.iteration)
        scalars = status.scalars
        parts = [
            f"{status.iteration}/{status.iterations}",
            f"{status.steps / 1e6:.2f} M steps",
            f"{scalars['Perf/steps_per_second']:,.0f}/s",
            f"left {_duration(left)}",
            f"reward {scalars['Critic/task_reward']:.2f}",
        ]
        if "Discriminator/policy" in scalars:
            expert, policy = scalars["Discriminator/expert"], scalars["Discriminator/policy"]
            parts.append(f"D {expert:+.2f}/{policy:+.2f}")
        if status.evaluation:
            parts.append("h [cm], pitch, v: " + " ".join(map(_brief, status.evaluation.values())))
        if status.terrain:
            parts.append("success/feet only [%]: " + " ".join(_shares(status.terrain)))
        return " | ".join(parts)


def _brief(result: SkillResult) -> str:
    height, pitch = 100 * result.height, math.degrees(result.pitch)
    return f"{height:.0f},{pitch:+.0f},{result.velocity:.2f}"


def _shares(terrain: TerrainResult) -> Iterator[str]:
    """Yield a terrain's success and success on feet only, of all skills, in %."""
    success, feet_only = (x.mean(dim=1).tolist() for x in (terrain.success, terrain.feet_only))
    for name, a, b in zip(terrain.terrains, success, feet_only, strict=True):
        yield f"{name} {100 * a:.0f}/{100 * b:.0f}"


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"
