"""What the page shows beside the drive itself; plain data that page and session share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from kiras_rl.tools.driving.viewer.detail import Detail

GHOSTS = {"off": 0.0, "inside": 0.0, "beside": 0.45}
"""Where the ghost stands: m to the left of the robot."""


@dataclass(frozen=True)
class Selector:
    """A list to choose from: policies, the ground."""

    label: str
    """Unique among all of them."""
    options: Callable[[], Sequence[str]]
    current: Callable[[], str]
    choose: Callable[[int], None]
    """Is called, from the page's thread, with the index of what was chosen."""
    heading: str = ""
    """Written above it; without one it stays below what comes before."""
    keys: str = ""
    """The keys that do the same."""
    share: int = 1
    """How many of its kind stand in a row."""


@dataclass
class View:
    """What is looked at, what can be chosen, and how well the clock is kept."""

    ghost: str = "inside"
    follow: bool = True
    typing: bool = False
    """Whether keys go into a field of the page."""
    real_time: float = 1.0
    """Simulated seconds in a second, over the last ones, at full speed."""
    gamepad: str = ""
    selectors: list[Selector] = field(default_factory=list)
    detail: Detail = field(default_factory=Detail)
    """How much is drawn."""

    @property
    def side(self) -> float:
        """How far to the left of the robot the ghost stands, m."""
        return GHOSTS[self.ghost]

    def next_ghost(self) -> None:
        """Go on to the next place of the ghost."""
        names = list(GHOSTS)
        self.ghost = names[(names.index(self.ghost) + 1) % len(names)]
