"""How much the page draws: less where its pictures are slow."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

_SLOW, _CRAWLING = 10.0, 3.0  # pictures a second: to be steered by, and of no use
_FAST = 45.0  # nearly what a screen shows
_PATIENCE = 60.0  # s until more is tried again: every change builds the scene anew


@dataclass(frozen=True)
class Level:
    """What is drawn.

    Attributes:
        plain: Without shadows, soft shading in corners, glow and antialiasing.
        share: Of the pixels along each side of the screen.
    """

    plain: bool
    share: float


LEVELS = (Level(plain=False, share=1.0), Level(plain=True, share=1.0), Level(plain=True, share=0.5))
"""From all to least."""


class Detail:
    """Chooses a level by the pictures a second that the page tells."""

    def __init__(
        self, levels: Sequence[Level] = LEVELS, now: Callable[[], float] = time.monotonic
    ) -> None:
        """Begin with the first level.

        Args:
            levels: From most to least.
            now: Returns the time, s.
        """
        self._levels, self._now, self._number = levels, now, 0
        self._changed = -float("inf")
        self._settling = False

    @property
    def is_reduced(self) -> bool:
        """Whether less than all is drawn."""
        return self._number > 0

    @property
    def level(self) -> Level:
        """What is to be drawn."""
        return self._levels[self._number]

    def judge(self, pictures: float) -> None:
        """Hear how many pictures a second were drawn of late."""
        if self._settling:  # the scene was being built
            self._settling = False
        elif pictures < _SLOW:
            self._choose(len(self._levels) - 1 if pictures < _CRAWLING else self._number + 1)
        elif pictures > _FAST and self._now() - self._changed > _PATIENCE:
            self._choose(self._number - 1)

    def _choose(self, number: int) -> None:
        number = min(max(number, 0), len(self._levels) - 1)
        if number != self._number:
            self._number, self._changed, self._settling = number, self._now(), True
