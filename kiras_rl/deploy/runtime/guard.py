"""The driver's judge: what the motors do now, whatever the runtime does or does not say."""

from __future__ import annotations

import numpy as np

from kiras_rl.deploy.runtime.messages import NANO, ORDER, Mode

HOLD = 0.1  # s that the last targets are held after an order has run out
FUTURE = 0.005  # s; an order that says it was made later than this from now has a broken clock


class Guard:
    """Turns orders into what the motors do; a runtime that is late is held, then damped.

    Damping is latched: servo orders count again after the runtime itself has ordered Mode.DAMP or
    Mode.OFF, which says that it knows.

    Attributes:
        reason: Why the driver itself damps; empty while it does not.
    """

    def __init__(self) -> None:
        """Begin with motors that are off."""
        self._order = np.zeros((), ORDER)  # Mode.OFF
        self._begun = False
        self.reason = ""

    def decide(self, order: np.ndarray | None, now: int, alive: bool, emergency: bool) -> Mode:
        """Return what to do.

        Args:
            order: The newest order that came, or None.
            now: ns.
            alive: Whether the runtime's process lives.
            emergency: Whether somebody presses the button.
        """
        if order is not None and order["time"] > self._order["time"] and self._is_sound(order, now):
            self._order, self._begun = order, True
        mode = Mode(int(self._order["mode"]))
        late = (now - int(self._order["valid_until"])) / NANO
        if not self._begun:
            return Mode.OFF
        if emergency:
            self.reason = "emergency"
        elif not alive:
            self.reason = "runtime is gone"
        elif late > HOLD or self._is_early(now):
            self.reason = f"no order for {1000 * max(late, 0.0):.0f} ms"
        elif self.reason and late <= 0 and mode in (Mode.DAMP, Mode.OFF):
            self.reason = ""
        if self.reason:
            return Mode.DAMP
        return mode if late <= 0 or mode in (Mode.DAMP, Mode.OFF) else Mode.HOLD

    @property
    def order(self) -> np.ndarray:
        """The order that counts: targets and gains of Mode.SERVO and Mode.HOLD. Shape ()."""
        return self._order

    def _is_sound(self, order: np.ndarray, now: int) -> bool:
        numbers = np.concatenate([order["target"], order["kp"], order["kd"]])
        return bool(np.isfinite(numbers).all()) and int(order["time"]) <= now + FUTURE * NANO

    def _is_early(self, now: int) -> bool:
        return int(self._order["time"]) > now + FUTURE * NANO
