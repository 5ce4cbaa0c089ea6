"""The protocols of kiras-evaluate: each measures one policy, and shows one or several.

A protocol is a module with

- TITLE and TEXT: a heading, and what is measured and how,
- measure(subject) -> plain values, measured piece by piece with `subject.results`, which keeps
  them and shows the progress,
- section(results): tables and figures of the values of one or several policies, by their label.
"""

from __future__ import annotations

from types import ModuleType

from kiras_rl.tools.protocols import (
    flat,
    heat_map,
    imitation,
    obstacles,
    robustness,
    sampling,
    terrain,
    transitions,
)

PROTOCOLS: dict[str, ModuleType] = {
    "flat": flat,
    "imitation": imitation,
    "transitions": transitions,
    "terrain": terrain,
    "heat_map": heat_map,
    "obstacles": obstacles,
    "robustness": robustness,
    "sampling": sampling,
}
"""By the name that kiras-evaluate knows them by, in the order of a report."""
