"""Robots to test, and a copy to break."""

import shutil

import pytest
import yaml

from kiras_rl.robots.robot import ROBOTS, load_robot


@pytest.fixture
def solo8():
    return load_robot("solo8")


@pytest.fixture
def go1():
    return load_robot("go1")


@pytest.fixture
def edit(tmp_path):
    """Return a function that changes entries of a copied Solo-8 file and loads the copy."""
    shutil.copytree(ROBOTS / "solo8", tmp_path / "solo8")

    def change(file, **entries):
        path = tmp_path / "solo8" / file
        content = yaml.safe_load(path.read_text()) | entries
        content = {key: value for key, value in content.items() if value is not None}
        path.write_text(yaml.safe_dump(content, sort_keys=False))
        return load_robot("solo8", root=tmp_path)

    return change
