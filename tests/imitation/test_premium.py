"""The premium selector, on motions whose every frame is known."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from kiras_rl.config import ConfigError
from kiras_rl.imitation.premium import PremiumSelector, trajectory_scores
from kiras_rl.schema import PremiumConfig

WINDOW, STEPS, WORLDS, FEATURES = 5, 4, 3, 2
KEYFRAMES = torch.tensor([[0.0, 0.0], [10.0, 0.0]])
CONFIG = PremiumConfig(
    rule="topk", window=WINDOW, capacity=3, max_age=10, min_command=0.2, min_progress=0.5,
    max_distance=1e9, per_iteration=2, keyframe_share=0.5, distance_weight=1.0,
)  # fmt: skip


class Recorder:
    """Feeds a selector step by step; Phi is (step, world) unless given."""

    def __init__(self, num_worlds=WORLDS, **changes):
        config = dataclasses.replace(CONFIG, **changes)
        self.selector = PremiumSelector(config, KEYFRAMES, num_worlds, STEPS)
        self.num_worlds, self.time = num_worlds, 0

    def steps(
        self, count, skill=0, reward=0.0, speed=0.5, progress=1.0, done=False, valid=True,
        features=None,
    ):  # fmt: skip
        """Record steps in which every world is alike, or differs by a list of values."""

        def each(value, dtype):
            return torch.as_tensor(value, dtype=dtype).expand(self.num_worlds)

        for _ in range(count):
            counted = torch.stack([torch.full((self.num_worlds,), float(self.time)),
                                   torch.arange(self.num_worlds).float()], dim=1)  # fmt: skip
            self.selector.record(
                features=counted if features is None else features,
                skill=each(skill, torch.int64),
                reward=each(reward, torch.float32),
                speed=each(speed, torch.float32),
                progress=each(progress, torch.float32),
                done=each(done, torch.bool),
                valid=each(valid, torch.bool),
            )
            self.time += 1

    def select(self, iteration=0):
        self.selector.select(iteration)
        return self.selector.counts.tolist()


def dtw(trajectory, keyframe):
    """Dynamic time warping between a trajectory and a keyframe held as long, by its definition."""
    count = len(trajectory)
    cost = torch.full((count + 1, count + 1), torch.inf)
    cost[0, 0] = 0.0
    for i in range(1, count + 1):
        for j in range(1, count + 1):
            least = min(cost[i - 1, j], cost[i, j - 1], cost[i - 1, j - 1])
            cost[i, j] = torch.dist(trajectory[i - 1], keyframe) + least
    return cost[-1, -1]


def test_the_distance_is_dynamic_time_warping_to_the_keyframe():
    trajectory, rewards = torch.randn(WINDOW, FEATURES), torch.rand(WINDOW)
    recorder = Recorder(num_worlds=1, distance_weight=0.7)
    for frame, reward in zip(trajectory, rewards, strict=True):
        recorder.steps(1, skill=1, reward=reward, features=frame[None])
    assert recorder.select() == [0, 1]
    expected = rewards.mean() - 0.7 * dtw(trajectory, KEYFRAMES[1]) / WINDOW
    torch.testing.assert_close(recorder.selector.scores[1, 0], expected)


def test_far_from_the_keyframe_scores_lower():
    reward, distance = torch.tensor([50.0, 50.0]), torch.tensor([10.0, 20.0])
    scores = trajectory_scores(reward, distance, length=10, distance_weight=2.0)
    assert scores.tolist() == [3.0, 1.0]


def test_a_window_is_kept_frame_by_frame():
    recorder = Recorder()
    recorder.steps(WINDOW)
    assert recorder.select() == [2, 0]  # of three worlds the best two
    kept = recorder.selector.trajectories[0, 0]
    assert kept[:, 0].tolist() == [0, 1, 2, 3, 4]
    assert kept[:, 1].tolist() == [0] * WINDOW  # world 0 is nearest to the keyframe


@pytest.mark.parametrize("late", range(STEPS))
def test_a_window_that_ends_early_in_a_rollout_survives_to_its_end(late):
    recorder = Recorder()
    recorder.steps(50, done=True)  # the ring has turned several times
    begin = recorder.time
    recorder.steps(WINDOW + late)
    recorder.select()
    assert recorder.selector.trajectories[0, 0, :, 0].tolist() == [begin + i for i in range(WINDOW)]


def test_an_incomplete_window_does_not_count():
    recorder = Recorder()
    recorder.steps(WINDOW - 1)
    assert recorder.select() == [0, 0]


def test_a_window_with_a_fall_is_rejected():
    recorder = Recorder()
    recorder.steps(2)
    recorder.steps(1, done=[True, False, False], valid=[False, True, True])
    recorder.steps(2)
    recorder.select()
    assert recorder.selector.trajectories[0, :2, 0, 1].tolist() == [1, 2]  # not world 0
    recorder.steps(2)
    recorder.steps(1)  # world 0 now has five steps since its fall
    recorder.select()
    assert recorder.selector.trajectories[0, :, 0, 1].tolist() == [1, 2, 0]


def test_the_failing_step_itself_spoils_a_window():
    recorder = Recorder()
    recorder.steps(WINDOW - 1)
    recorder.steps(1, done=True, valid=False)
    assert recorder.select() == [0, 0]


def test_a_window_that_ends_with_the_clock_counts():
    recorder = Recorder()
    recorder.steps(WINDOW - 1)
    recorder.steps(1, done=True)
    assert recorder.select() == [2, 0]
    recorder.steps(WINDOW - 1)
    assert recorder.select() == [2, 0]


def test_a_change_of_skill_begins_a_new_window():
    recorder = Recorder()
    recorder.steps(3, skill=0)
    recorder.steps(WINDOW - 1, skill=1)
    assert recorder.select() == [0, 0]
    recorder.steps(1, skill=1)
    assert recorder.select() == [0, 2]
    assert recorder.selector.trajectories[1, 0, :, 0].tolist() == [3, 4, 5, 6, 7]


def test_a_window_that_is_hardly_asked_to_move_is_no_premium_motion():
    recorder = Recorder()
    for speed in (0.5, 0.4, 0.0, 0.0, 0.0):  # mean 0.18 where the command ends, 0.2 elsewhere
        recorder.steps(1, speed=[speed, 0.2, 0.0])
    assert recorder.select() == [1, 0]
    assert recorder.selector.trajectories[0, 0, 0, 1] == 1


def test_standing_is_no_premium_motion():
    recorder = Recorder()
    for progress in ([0.0, 1.0, 0.2], [0.0, 0.25, 0.2], [0.0, 0.0, 0.2]):
        recorder.steps(1, speed=0.5, progress=progress)
    recorder.steps(WINDOW - 3, speed=0.5, progress=[0.0, 0.0, 0.2])
    assert recorder.select() == [1, 0]  # 1.25 of 2.5 m/s is half of the way, 1.0 is less
    assert recorder.selector.trajectories[0, 0, 0, 1] == 1


def test_a_motion_far_from_its_keyframe_is_no_premium_motion():
    recorder = Recorder(max_distance=1.0)
    for _ in range(WINDOW):
        recorder.steps(1, features=torch.tensor([[0.9, 0.0], [1.1, 0.0], [0.0, 0.8]]))
    assert recorder.select() == [2, 0]
    assert recorder.selector.scores[0, :2].tolist() == pytest.approx([-0.8, -0.9])


def test_the_best_come_first_and_the_worst_drop_out():
    recorder = Recorder(distance_weight=0.0)
    for iteration, rewards in enumerate([[1, 5, 3], [4, 0, 2], [0, 0, 9]]):
        recorder.steps(WINDOW, reward=rewards)
        recorder.select(iteration)
    scores = recorder.selector.scores[0].tolist()
    assert scores == [9, 5, 4]  # 3 and 2 entered, but three places are all there are
    assert recorder.selector.trajectories[0, :, 0, 1].tolist() == [2, 1, 0]


def test_the_old_make_room():
    recorder = Recorder(distance_weight=0.0, max_age=2)
    recorder.steps(WINDOW, reward=[7, 6, 0])
    recorder.select(iteration=0)
    recorder.steps(WINDOW, reward=[1, 2, 0])
    assert recorder.select(iteration=2) == [3, 0]
    assert recorder.select(iteration=3) == [1, 0]
    assert recorder.selector.scores[0, 0] == 2


def test_by_the_paper_s_rule_only_a_record_enters():
    recorder = Recorder(distance_weight=0.0, rule="record", max_age=0)
    for iteration, rewards in enumerate([[3, 1, 2], [2, 2, 3], [5, 4, 1]]):
        recorder.steps(WINDOW, reward=rewards)
        recorder.select(iteration)
    assert recorder.selector.scores[0].tolist() == [5, 4, 3]  # nothing of the second round


def test_expert_pairs_are_successive_frames_and_a_share_of_keyframes():
    recorder = Recorder(keyframe_share=0.25)
    recorder.steps(3, done=True)
    recorder.steps(WINDOW, skill=0)
    recorder.select()
    pairs = recorder.selector.sample(torch.zeros(4000, dtype=torch.int64))
    before, after = pairs.chunk(2, dim=1)
    rests = (before == KEYFRAMES[0]).all(1) & (after == KEYFRAMES[0]).all(1)
    assert rests.float().mean() == pytest.approx(0.25, abs=0.03)
    assert torch.equal(before[~rests, 0] + 1, after[~rests, 0])  # the step
    assert torch.equal(before[~rests, 1], after[~rests, 1])  # the world
    assert before[~rests, 0].unique().tolist() == [3, 4, 5, 6]
    assert before[~rests, 1].unique().tolist() == [0, 1]


def test_a_skill_without_trajectories_is_taught_by_its_keyframe():
    recorder = Recorder()
    recorder.steps(WINDOW, skill=0)
    recorder.select()
    pairs = recorder.selector.sample(torch.ones(100, dtype=torch.int64))
    assert torch.equal(pairs, KEYFRAMES[1].repeat(100, 2))


def test_a_saved_selector_goes_on_within_a_window():
    recorder, other = Recorder(), Recorder()
    recorder.steps(3)
    state = {k: v.clone() if torch.is_tensor(v) else v
             for k, v in recorder.selector.state_dict().items()}  # fmt: skip
    other.selector.load_state_dict(state)
    other.time = recorder.time
    for each in (recorder, other):
        each.steps(WINDOW)
        each.select()
    assert torch.equal(recorder.selector.trajectories, other.selector.trajectories)
    assert torch.equal(recorder.selector.scores, other.selector.scores)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rule": "best"}, "premium.rule=best: allowed are topk, record"),
        ({"window": 3}, "premium.window=3: at least the 4 steps of a rollout"),
    ],
)
def test_a_selector_that_cannot_work_is_refused(change, message):
    with pytest.raises(ConfigError, match=message):
        Recorder(**change)
