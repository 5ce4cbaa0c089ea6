"""Ground for tests that drive on it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from kiras_rl.config import load_config
from kiras_rl.phases import FINETUNING, phase_of
from kiras_rl.tools.driving.ground import Terrain


@pytest.fixture(scope="session")
def terrain():
    """Return the tiles of configuration base."""
    return Terrain(phase_of(load_config("base"), FINETUNING).config.env.terrain)


@pytest.fixture(scope="session")
def smooth_terrain(terrain):
    """Return the same tiles without bumps, whose heights can be had by hand."""
    return Terrain(replace(terrain.config, noise=(0.0, 0.0)))
