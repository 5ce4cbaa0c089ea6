"""Keys of the page: each does what it says, however late and close together they arrive."""

from __future__ import annotations

import math

from kiras_rl.tools.driving.viewer import bindings
from kiras_rl.tools.driving.viewer.cockpit import Cockpit
from kiras_rl.tools.driving.viewer.view import View

_LET_GO = 1e-3  # s: a hold that is over in the next step


class Keys:
    """The keys that one page holds down.

    A page that draws slowly tells of a key late, and of its release in the same moment. The page's
    own times say how long it was held: what is missing is made up for.
    """

    def __init__(self, cockpit: Cockpit, view: View) -> None:
        """Start with no key held."""
        self._cockpit, self._view = cockpit, view
        self._held: dict[str, tuple[float, float]] = {}  # when: in the page, and here; s

    def press(self, name: str, at: float, now: float) -> None:
        """Press a key.

        Args:
            name: As `bindings` calls it.
            at: Time of the page, s.
            now: Time here, s.
        """
        if self._view.typing:
            return
        if name in bindings.HELD:
            self._held[name] = at, now
            self._hold(name, math.inf)
        elif name == "G":
            self._view.next_ghost()
        elif name == "C":
            self._view.follow = not self._view.follow
        else:
            bindings.press(self._cockpit, name)

    def release(self, name: str, at: float, now: float) -> None:
        """Let a key go; another one of its axis that is still held acts again."""
        if name not in self._held:
            return
        pressed_at, pressed = self._held.pop(name)
        axis, _ = bindings.HELD[name]
        others = [key for key in self._held if bindings.HELD[key][0] == axis]
        if others:
            self._hold(others[-1], math.inf)
        else:
            self._hold(name, max((at - pressed_at) - (now - pressed), _LET_GO))

    def release_all(self) -> None:
        """Let all keys go, as when the page goes away."""
        for name in self._held:
            self._hold(name, _LET_GO)
        self._held.clear()

    def _hold(self, name: str, seconds: float) -> None:
        self._cockpit.post(self._cockpit.hold, *bindings.HELD[name], seconds)
