"""Levels follow success: half of the episodes at the frontier of a skill on a type of terrain."""

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
from kiras_rl.phases import FINETUNING, phase_of

WORLDS, SKILLS = 10, 3


@pytest.fixture(scope="module")
def library():
    config = phase_of(load_config("base"), FINETUNING).config.env.terrain
    return build_library(dataclasses.replace(config, levels=3, variants=2))


def make(library, worlds=WORLDS, seed=0):
    random = UniformBuffer(worlds, COLUMNS, torch.Generator().manual_seed(seed))
    random.refill()
    return Curriculum(library, SKILLS, random)


@pytest.fixture
def curriculum(library):
    return make(library)


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


def end(curriculum, worlds, *, fallen=(), crossed=(), skill=0, times=1):
    """End episodes of some worlds, each of them several times."""
    for _ in range(times):
        curriculum.update(flags(*worlds), flags(*fallen), flags(*crossed), skills(skill))


def test_types_are_dealt_by_their_proportions(curriculum, library):
    counts = torch.bincount(make(library, worlds=1000).kind, minlength=len(library.types))
    assert counts.tolist() == [150, 100, 200, 200, 200, 150, 0, 0, 0, 0]
    names = [library.types[k] for k in curriculum.kind.tolist()]
    assert names[0] == "flat" and names[3] == "bars"  # as the tests below have it


def test_every_skill_begins_at_the_lowest_level_of_every_type(curriculum, library):
    assert curriculum.frontier.tolist() == [[0] * SKILLS] * len(library.types)
    assert curriculum.level.tolist() == [0] * WORLDS


def test_enough_crossings_move_the_frontier_of_that_skill_and_type_alone(curriculum, library):
    end(curriculum, [3], crossed=[3], skill=2, times=20)
    bars = library.types.index("bars")
    assert curriculum.frontier[bars].tolist() == [0, 0, 1]
    assert curriculum.frontier.sum() == 1


def test_a_few_crossings_are_not_enough(curriculum):
    end(curriculum, [3], crossed=[3], times=4)
    assert curriculum.frontier.sum() == 0


def test_who_falls_too_often_does_not_move_on(curriculum):
    for _ in range(20):  # two of three succeed
        end(curriculum, [3], crossed=[3], times=2)
        end(curriculum, [3], fallen=[3], crossed=[3])
    assert curriculum.frontier.sum() == 0


def test_a_skill_that_is_lost_comes_back_to_where_it_fails(curriculum, library):
    bars = library.types.index("bars")
    end(curriculum, [3], crossed=[3], times=30)
    assert curriculum.frontier[bars, 0] == 1
    end(curriculum, [3], fallen=[3], times=10)
    assert curriculum.frontier[bars, 0] == 0


@pytest.mark.parametrize(
    ("command", "velocity", "success"),
    [
        ((0.3, 0.0, 0.0), (0.20, 0.0, 0.0), 0),  # 2 m of 3 m
        ((0.3, 0.0, 0.0), (0.24, 0.0, 0.0), 1),  # more than three quarters
        ((-0.3, 0.0, 0.6), (-0.3, 0.0, 0.0), 1),  # backwards, and in a circle
        ((-0.3, 0.0, 0.0), (0.3, 0.0, 0.0), 0),  # the wrong way
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), None),  # told to stand
        ((0.0, 0.0, 0.6), (0.0, 0.0, 0.0), None),  # told to turn
        ((0.09, 0.0, 0.0), (0.0, 0.0, 0.0), None),  # 0.9 m: too little to judge
        ((0.15, 0.0, 0.0), (0.15, 0.0, 0.0), 0),  # all of 1.5 m, which is no way to speak of
    ],
)
def test_a_trial_is_judged_by_the_share_of_the_commanded_way(
    curriculum, command, velocity, success
):
    walk(curriculum, 10, command, velocity)
    end(curriculum, [7])
    log = curriculum.describe(("walk", "crawl", "stilt"))
    tries = curriculum.state_dict()["_tries"].sum()
    assert tries == (success is not None)
    assert log["Terrain/success_level_0"] == (success or 0)


def test_the_way_of_an_episode_begins_at_its_reset(curriculum):
    walk(curriculum, 10, (0.3, 0.0, 0.0), (0.02, 0.0, 0.0))
    end(curriculum, [7])
    walk(curriculum, 10, (0.3, 0.0, 0.0), (0.3, 0.0, 0.0))
    end(curriculum, [7])
    log = curriculum.describe(("walk", "crawl", "stilt"))
    assert log["Terrain/success_level_0"] == pytest.approx(1 / 1.95)  # the older one has faded


def test_episodes_in_which_the_skill_changed_do_not_count(curriculum):
    curriculum.keep_counting(~flags(3))
    end(curriculum, [3], crossed=[3])
    assert curriculum.state_dict()["_tries"].sum() == 0
    end(curriculum, [3], crossed=[3])  # the next episode does
    assert curriculum.state_dict()["_tries"].sum() == 1


def test_half_of_the_episodes_begin_at_the_frontier(library):
    curriculum = make(library, worlds=3000)
    tries = curriculum.state_dict()["_tries"]
    tries[:, :, :2] = 20.0  # levels 0 and 1 of 3 are left behind
    curriculum.state_dict()["_successes"][:] = tries
    everyone = torch.ones(3000, dtype=torch.bool)
    curriculum.begin(everyone, torch.zeros(3000, dtype=torch.int64))
    assert (curriculum.frontier == 2).all()
    shares = torch.bincount(curriculum.level, minlength=3) / 3000
    # A half at the frontier; the other half anywhere, which is at the top the same as up to it.
    torch.testing.assert_close(shares, torch.tensor([1 / 6, 1 / 6, 2 / 3]), atol=0.03, rtol=0)


def test_running_episodes_keep_their_level(library):
    curriculum = make(library)
    curriculum.level[:] = 2
    curriculum.begin(flags(4), skills())
    assert curriculum.level[[0, 1, 2, 3, 5]].tolist() == [2] * 5


def test_tiles_are_of_the_world_s_type_and_level(curriculum, library):
    curriculum.level[:] = 2
    tile = curriculum.tiles()
    assert torch.equal(tile // (library.levels * library.variants), curriculum.kind)
    assert set((tile // library.variants % library.levels).tolist()) == {2}
    assert set((tile % library.variants).tolist()) == {0, 1}


def test_frontiers_and_successes_are_described(curriculum):
    end(curriculum, [3], crossed=[3], skill=0, times=20)
    log = curriculum.describe(("walk", "crawl", "stilt"))
    assert log["Terrain/level_bars"] == pytest.approx(1 / 3)
    library = curriculum._library
    shares = zip(library.types, library.proportions, strict=True)
    trained = [kind for kind, share in shares if share > 0 and kind != "flat"]
    assert log["Terrain/level_walk"] == pytest.approx(1 / len(trained))
    end(curriculum, [0], fallen=[0])
    again = curriculum.describe(("walk", "crawl", "stilt"))
    assert again["Terrain/success_level_0"] == 1.0  # flat ground does not count


def test_a_saved_curriculum_goes_on(curriculum, library):
    walk(curriculum, 3, (0.3, 0.0, 0.0), (0.1, 0.0, 0.0))
    end(curriculum, [1], crossed=[1])
    other = make(library, seed=1)
    other.load_state_dict(curriculum.state_dict())
    for name, value in curriculum.state_dict().items():
        assert torch.equal(other.state_dict()[name], value), name
