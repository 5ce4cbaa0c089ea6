"""The protocols of kiras-evaluate: each measures one policy, and shows one or several.

A protocol is a module with

- TITLE and TEXT: a heading, and what is measured and how,
- measure(subject) -> plain values, measured piece by piece with `subject.results`, which keeps
  them and shows the progress,
- is_known(subject), if not every policy has what it asks: whether this one has,
- section(results): tables and figures of the values of one or several policies, by their label.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from types import ModuleType

from kiras_rl.tools.evaluation.protocols import (
    flat,
    heat_map,
    imitation,
    learning,
    limits,
    obstacles,
    robustness,
    sampling,
    sim2sim,
    terrain,
    transitions,
)
from kiras_rl.tools.evaluation.protocols.subject import Subject

PROTOCOLS: dict[str, ModuleType] = {
    "flat": flat,
    "imitation": imitation,
    "limits": limits,
    "transitions": transitions,
    "terrain": terrain,
    "heat_map": heat_map,
    "obstacles": obstacles,
    "robustness": robustness,
    "sim2sim": sim2sim,
    "sampling": sampling,
    "learning": learning,
}
"""By the name that kiras-evaluate knows them by, in the order of a report."""


def known(names: Iterable[str], subjects: Sequence[Subject]) -> list[str]:
    """Return the protocols among `names`, in the order of a report, that can be asked of all."""

    def is_known(name: str) -> bool:
        asks = getattr(PROTOCOLS[name], "is_known", None)
        return asks is None or all(map(asks, subjects))

    return [name for name in PROTOCOLS if name in set(names) and is_known(name)]
