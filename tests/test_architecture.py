"""Who may import whom. A learner without a simulator, a simulator without a learner."""

from __future__ import annotations

import ast
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parent.parent
MAPPED = ("envs", "robots", "cfg", "tools")  # top-level folders, imported as kiras_rl.<folder>


class Rule(NamedTuple):
    """What a part may import beside the standard library; `but` takes away from `may`."""

    may: tuple[str, ...]
    but: tuple[str, ...] = ()


LEARNING = Rule(
    ("torch", "rsl_rl", "tensordict", "numpy", "onnx", "yaml", "kiras_rl"),
    but=("kiras_rl.envs", "kiras_rl.robots", "kiras_rl.tools"),
)
SIMULATION = Rule(
    (
        *("torch", "tensordict", "numpy", "mujoco"),
        *(
            "kiras_rl.envs",
            "kiras_rl.robots",
            "kiras_rl.interfaces",
            "kiras_rl.recorded",
            "kiras_rl.config",
            "kiras_rl.deploy.errors",
            "kiras_rl.deploy.terms",  # what an observation is on the robot
            "kiras_rl.schedules",
            "kiras_rl.schema",
        ),
    )
)
ANYTHING = Rule(("",))
RULES = {  # the longest name that fits a module counts
    "kiras_rl": LEARNING,
    "kiras_rl.config": LEARNING._replace(may=(*LEARNING.may, "omegaconf")),
    "kiras_rl.evaluation.dtw": LEARNING._replace(may=(*LEARNING.may, "dtaidistance")),
    "kiras_rl.export": LEARNING._replace(may=(*LEARNING.may, "onnxruntime")),  # the parity check
    "kiras_rl.graphics": Rule(("mujoco",)),
    "kiras_rl.ownership": LEARNING._replace(may=(*LEARNING.may, "filelock")),
    "kiras_rl.recorded": Rule(("torch",)),
    "kiras_rl.dataset": Rule(("numpy", "kiras_rl.lerobot", "kiras_rl.deploy.errors")),
    "kiras_rl.lerobot": Rule(("numpy", "pyarrow", "kiras_rl.dataset")),
    "kiras_rl.deploy": Rule(("numpy", "onnxruntime", "kiras_rl.deploy")),
    "kiras_rl.deploy.runtime.profiles": Rule(("kiras_rl.deploy", "kiras_rl.robots.robot")),
    "kiras_rl.deploy.runtime.simulated": Rule(
        ("numpy", "mujoco", "kiras_rl.deploy", "kiras_rl.robots")
    ),
    "kiras_rl.robots": Rule(
        (
            *("numpy", "mujoco"),
            *("kiras_rl.robots", "kiras_rl.yaml_files", "kiras_rl.graphics"),
            "kiras_rl.deploy.errors",
        )
    ),
    "kiras_rl.envs": SIMULATION,
    "kiras_rl.envs.simulation.warp": Rule((*SIMULATION.may, "warp", "mujoco_warp")),
    "kiras_rl.cfg": Rule(()),
    "kiras_rl.tools": ANYTHING,
    "tests": ANYTHING,
}


def within(name: str, parts: tuple[str, ...]) -> bool:
    """Tell whether a dotted name is one of the parts, or lies in one."""
    return any(part == "" or f"{name}.".startswith(f"{part}.") for part in parts)


def imported_names(source: str) -> list[str]:
    """List what a source imports anywhere, functions included: `a.b` for `from a import b`."""
    names = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            start = "." * node.level + (node.module or "")
            names += [f"{start}.{alias.name}" for alias in node.names]
    return names


def violations(module: str, source: str) -> list[str]:
    """List the imports of a module that its rule forbids."""
    rule = RULES[max((part for part in RULES if within(module, (part,))), key=len)]

    def allowed(name: str) -> bool:
        if name.startswith(".") or within(name, MAPPED):
            return False  # one module, one name: always by kiras_rl.
        if name.split(".")[0] in sys.stdlib_module_names:
            return True
        return within(name, rule.may) and not within(name, rule.but)

    return [f"{module} imports {name}" for name in imported_names(source) if not allowed(name)]


def sources() -> list[tuple[str, Path]]:
    """List every Python file beside the name under which it is imported."""
    found = []
    for folder in ("kiras_rl", *MAPPED, "tests"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            name = name.removesuffix(".__init__")
            found.append((f"kiras_rl.{name}" if folder in MAPPED else name, path))
    return found


def test_every_import_is_allowed():
    faults = [v for name, path in sources() for v in violations(name, path.read_text("utf-8"))]
    assert not faults, "\n".join(faults)


def test_the_package_itself_imports_nothing():
    """The robot imports it too, on the way to kiras_rl.deploy."""
    names = imported_names((ROOT / "kiras_rl" / "__init__.py").read_text("utf-8"))
    assert [name for name in names if name.split(".")[0] not in sys.stdlib_module_names] == []


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("kiras_rl.runner", "import mujoco"),
        ("kiras_rl.runner", "import mujoco.batch as batch"),
        ("kiras_rl.runner", "def f():\n    import warp as wp"),
        ("kiras_rl.runner", "from omegaconf import OmegaConf"),
        ("kiras_rl.skills", "from kiras_rl.envs import make_env"),
        ("kiras_rl.skills", "from kiras_rl import robots"),
        ("kiras_rl.models.ece", "from kiras_rl.tools.train import main"),
        ("kiras_rl.models.ece", "from . import discriminator"),
        ("kiras_rl.deploy.policy", "import torch"),
        ("kiras_rl.deploy.policy", "from kiras_rl.interfaces import SkillEnv"),
        ("kiras_rl.envs.rewards", "import warp as wp"),
        ("kiras_rl.envs.rewards", "from kiras_rl.algorithms import losses"),
        ("kiras_rl.robots.robot", "import torch"),
        ("kiras_rl.robots.robot", "from kiras_rl.envs import make_env"),
        ("kiras_rl.cfg", "import yaml"),
        ("kiras_rl.tools.train", "import envs"),
        ("tests.test_x", "from robots.robot import load_robot"),
    ],
)
def test_a_planted_fault_is_reported(module, source):
    assert len(violations(module, source)) == 1


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("kiras_rl.runner", "import os\nimport torch.nn as nn\nfrom kiras_rl import skills"),
        ("kiras_rl.config", "from omegaconf import OmegaConf"),
        ("kiras_rl.deploy.policy", "import numpy as np\nimport onnxruntime"),
        ("kiras_rl.envs.simulation.native", "import mujoco.batch\nfrom kiras_rl.envs import state"),
        ("kiras_rl.envs.simulation.warp", "import mujoco_warp\nimport warp as wp"),
        ("kiras_rl.tools.train", "import rich\nfrom kiras_rl.envs import make_env"),
    ],
)
def test_a_proper_import_is_not_reported(module, source):
    assert violations(module, source) == []
