"""Levels go up for who crosses, down for who falls or is stuck, each skill on its own."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import pytest
import torch

from kiras_rl.config import load_config
from kiras_rl.envs.curriculum import COLUMNS, Curriculum
from kiras_rl.envs.randomness import UniformBuffer
from kiras_rl.envs.state import Task
from kiras_rl.envs.terrain_library import build_library
from kiras_rl.phases import FINETUNING, phase_config

WORLDS, SKILLS = 10, 3


@pytest.fixture(scope="module")
def library():
    config = phase_config(load_config("base"), FINETUNING).env.terrain
    return build_library(dataclasses.replace(config, levels=3, variants=2))


@pytest.fixture
def curriculum(library):
    random = UniformBuffer(WORLDS, COLUMNS, torch.Generator().manual_seed(0))
    return Curriculum(library, SKILLS, random, start_level=0)


def flags(*worlds):
    mask = torch.zeros(WORLDS, dtype=torch.bool)
    mask[list(worlds)] = True
    return mask


def skills(value=0):
    return torch.full((WORLDS,), value)


def walk(curriculum, seconds, command, velocity):
    """Let all robots move for some seconds, in steps of 1 s."""
    row = torch.tensor(command).expand(WORLDS, 3)
    task = Task.of(row, skills(), skills())
    robot = SimpleNamespace(base_lin_vel_h=torch.tensor(velocity).expand(WORLDS, 3))
    for _ in range(seconds):
        curriculum.record(task, robot, dt=1.0)


def test_types_are_dealt_by_their_proportions(curriculum, library):
    names = [library.types[k] for k in curriculum.kind.tolist()]
    assert names == ["flat", *2 * ["slopes"], *2 * ["bars"], *2 * ["footholds"], *3 * ["stairs"]]


def test_the_first_levels_are_drawn_up_to_the_start_level(library):
    random = UniformBuffer(200, COLUMNS, torch.Generator().manual_seed(0))
    level = Curriculum(library, SKILLS, random, start_level=1).level
    assert level.unique().tolist() == [0, 1]
    assert level.float().mean(dim=0).tolist() == pytest.approx([0.5] * SKILLS, abs=0.1)


def test_crossing_promotes_the_skill_that_did_it(curriculum):
    curriculum.update(flags(1, 2), flags(), flags(1), skills(2))
    assert curriculum.level[1].tolist() == [0, 0, 1]
    assert curriculum.level.sum() == 1


def test_a_fall_demotes_to_the_lowest_level_at_most(curriculum):
    curriculum.level[:] = 1
    for _ in range(2):
        curriculum.update(flags(4), flags(4), flags(), skills(1))
    assert curriculum.level[4].tolist() == [1, 0, 1]


@pytest.mark.parametrize(
    ("command", "velocity", "level"),
    [
        ((0.3, 0.0, 0.0), (0.14, 0.0, 0.0), 0),  # 1.4 m of 3 m: stuck
        ((0.3, 0.0, 0.0), (0.16, 0.0, 0.0), 1),  # more than half of the way
        ((-0.3, 0.0, 0.6), (-0.3, 0.0, 0.0), 1),  # backwards, and in a circle
        ((-0.3, 0.0, 0.0), (0.3, 0.0, 0.0), 0),  # the wrong way
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1),  # told to stand
        ((0.0, 0.0, 0.6), (0.0, 0.0, 0.0), 1),  # told to turn
        ((0.09, 0.0, 0.0), (0.0, 0.0, 0.0), 1),  # 0.9 m: too little to judge
    ],
)
def test_who_makes_less_than_half_of_the_way_is_demoted(curriculum, command, velocity, level):
    curriculum.level[:] = 1
    walk(curriculum, 10, command, velocity)
    curriculum.update(flags(7), flags(), flags(), skills())
    assert curriculum.level[7, 0] == level


def test_the_way_of_an_episode_begins_at_its_reset(curriculum):
    curriculum.level[:] = 1
    walk(curriculum, 10, (0.3, 0.0, 0.0), (0.02, 0.0, 0.0))
    curriculum.update(flags(7), flags(), flags(), skills())
    walk(curriculum, 10, (0.3, 0.0, 0.0), (0.3, 0.0, 0.0))
    curriculum.update(flags(7, 8), flags(), flags(), skills())
    assert curriculum.level[7, 0] == 0  # as the first episode left it
    assert curriculum.level[8, 0] == 1  # more than half of its way, over both stretches


def test_episodes_in_which_the_skill_changed_do_not_count(curriculum):
    curriculum.keep_counting(~flags(3))
    curriculum.update(flags(3, 4), flags(), flags(3, 4), skills())
    assert curriculum.level[:, 0].tolist() == [0, 0, 0, 0, 1, 0, 0, 0, 0, 0]
    curriculum.update(flags(3), flags(), flags(3), skills())  # the next episode does
    assert curriculum.level[3, 0] == 1


def test_beyond_the_top_any_level_is_drawn(curriculum):
    curriculum.level[:] = 2
    everyone = torch.ones(WORLDS, dtype=torch.bool)
    curriculum.update(everyone, ~everyone, everyone, skills())
    assert set(curriculum.level[:, 0].tolist()) == {0, 1, 2}
    assert (curriculum.level[:, 1:] == 2).all()


def test_tiles_are_of_the_world_s_type_and_the_skill_s_level(curriculum, library):
    curriculum.level[:] = torch.tensor([0, 1, 2])
    tile = curriculum.tiles(skills(2))
    assert torch.equal(tile // (library.levels * library.variants), curriculum.kind)
    assert set((tile // library.variants % library.levels).tolist()) == {2}
    assert set((tile % library.variants).tolist()) == {0, 1}


def test_levels_and_successes_are_described(curriculum):
    curriculum.level[9] = torch.tensor([2, 1, 0])  # stairs, one world of three
    log = curriculum.describe(("walk", "crawl", "stilt"))
    assert log["Terrain/level_stairs"] == pytest.approx(1 / 3)
    assert log["Terrain/level_walk"] == pytest.approx(2 / 9)  # over the nine rough worlds
    curriculum.update(flags(0, 5, 6), flags(6), flags(0, 5), skills(1))
    log = curriculum.describe(("walk", "crawl", "stilt"))
    assert log["Terrain/success_level_0"] == pytest.approx(1 / 2)  # flat ground does not count


def test_a_saved_curriculum_goes_on(curriculum, library):
    walk(curriculum, 3, (0.3, 0.0, 0.0), (0.1, 0.0, 0.0))
    curriculum.update(flags(1), flags(), flags(1), skills())
    random = UniformBuffer(WORLDS, COLUMNS, torch.Generator().manual_seed(1))
    other = Curriculum(library, SKILLS, random, start_level=2)
    other.load_state_dict(curriculum.state_dict())
    for name, value in curriculum.state_dict().items():
        assert torch.equal(other.state_dict()[name], value), name
