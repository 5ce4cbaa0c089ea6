"""One result of several seeds."""

from __future__ import annotations

from typing import Any

COUNTS = "trials"
"""A mapping with this key holds counts: they add up."""
CURVES = "curves"
"""Lists under this key are kept side by side."""


def pool(results: list[Any]) -> Any:
    """Return the mean of numbers, the sum of counts, and curves side by side.

    Args:
        results: Nested values of the same structure; None where nothing was measured.
    """
    results = [r for r in results if r is not None]
    first = results[0] if results else None
    if len(results) <= 1:
        return first
    if isinstance(first, dict):
        if COUNTS in first:
            return {key: sum(r[key] for r in results) for key in first}
        return {
            key: [c for r in results for c in r[key]]
            if key == CURVES
            else pool([r.get(key) for r in results])
            for key in first
        }
    if isinstance(first, list) and all(isinstance(r, list) for r in results):
        return [pool(list(items)) for items in zip(*results, strict=False)]
    known = [r for r in results if isinstance(r, int | float) and not isinstance(r, bool)]
    return sum(known) / len(known) if known else first
