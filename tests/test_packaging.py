"""The hand-written lists of pyproject.toml against the folders: what they miss, the wheel lacks."""

from __future__ import annotations

import ast
import importlib
import tomllib
from pathlib import Path

import pytest

import kiras_rl

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
SETUPTOOLS = PROJECT["tool"]["setuptools"]
FOLDERS = {name: ROOT / folder for name, folder in SETUPTOOLS["package-dir"].items()}


def packages_on_disk() -> list[str]:
    """Name every folder that holds a Python file, as it is imported."""
    return sorted(
        ".".join([name, *folder.relative_to(top).parts])
        for name, top in FOLDERS.items()
        for folder in {path.parent for path in top.rglob("*.py")}
    )


def test_every_folder_with_code_is_a_listed_package():
    assert sorted(SETUPTOOLS["packages"]) == packages_on_disk()


def test_every_package_has_an_init_file():
    missing = [
        str(folder)
        for top in FOLDERS.values()
        for folder in {path.parent for path in top.rglob("*.py")}
        if not (folder / "__init__.py").is_file()
    ]
    assert not missing


@pytest.mark.parametrize(
    "package",
    ["kiras_rl.robots", "kiras_rl.cfg", "kiras_rl.tools.driving.viewer", "kiras_rl.baselines"],
)
def test_every_data_file_is_covered_by_a_pattern(package):
    top, _, inner = package.removeprefix("kiras_rl.").partition(".")
    folder = FOLDERS.get(f"kiras_rl.{top}", FOLDERS["kiras_rl"] / top) / inner
    covered = {path for glob in SETUPTOOLS["package-data"][package] for path in folder.glob(glob)}
    data = {
        path
        for path in folder.rglob("*")
        if path.is_file() and path.suffix not in {".py", ".pyc"} and path.name[0] != "."
    }
    assert sorted(map(str, data - covered)) == []


def test_the_onboard_part_is_of_this_version_and_of_old_pythons():
    folder = ROOT / "onboard"
    project = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))
    assert project["project"]["version"] == kiras_rl.__version__
    least = project["project"]["requires-python"].removeprefix(">=").split(".")
    for package, place in project["tool"]["setuptools"]["package-dir"].items():
        assert package in project["tool"]["setuptools"]["packages"]
        files = list((folder / place).glob("*.py"))
        assert files
        for path in files:
            tree = ast.parse(path.read_text("utf-8"), feature_version=(3, int(least[1])))
            newer = [
                node.arg for node in ast.walk(tree)
                if isinstance(node, ast.keyword) and node.arg == "strict"
            ]  # fmt: skip
            assert not newer, f"{path}: zip(strict=) is of Python 3.10"


def test_every_command_names_a_function_that_is_there():
    missing = []
    for script in PROJECT["project"]["scripts"].values():
        module, _, function = script.partition(":")
        if not callable(getattr(importlib.import_module(module), function, None)):
            missing.append(script)
    assert not missing


def test_the_onboard_part_has_the_command_that_drives_robots():
    onboard = tomllib.loads((ROOT / "onboard" / "pyproject.toml").read_text(encoding="utf-8"))
    command = onboard["project"]["scripts"]["kiras-robot"]
    assert command == PROJECT["project"]["scripts"]["kiras-robot"]
