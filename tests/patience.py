"""How long tests wait for what has to come: a guard against hanging, and no verdict on speed."""

from __future__ import annotations

EACH = 300.0  # s, for a machine that has much else to do
ALL = 900.0  # s that failing tests of one process may take: many of them never eat a whole CI
LEAST = 20.0  # s, once those are used up

_spent = 0.0


def patience() -> float:
    """Return how long to wait for one thing, s."""
    return min(EACH, max(LEAST, ALL - _spent))


def spend(seconds: float) -> None:
    """Count the time of a test that failed."""
    global _spent
    _spent += seconds
