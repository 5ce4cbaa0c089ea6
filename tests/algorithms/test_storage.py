"""Storage of groups, and how it is cut into batches."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from kiras_rl.algorithms.storage import GroupRolloutStorage, mini_batches

STEPS, WORLDS, ACTIONS = 3, 4, 2


def write(storage, value):
    """Write a step whose every number tells the step and the world, in two halves."""
    number = value + torch.arange(WORLDS).float()[:, None] / 10
    storage.claim_row()
    actions = number.expand(-1, ACTIONS)
    storage.write(
        {"a": number}, actions=actions, actions_log_prob=number.squeeze(1), action_mean=actions
    )
    one = number.squeeze(1)
    storage.write({}, task_rewards=one, dones=one > 1.2, time_outs=one > 2.2)
    storage.next_row()


@pytest.fixture
def storage():
    obs = TensorDict({"a": torch.zeros(WORLDS, 1)}, batch_size=[WORLDS])
    return GroupRolloutStorage(WORLDS, STEPS, 2, obs, ACTIONS, "cpu")


def test_every_step_has_its_row(storage):
    for t in range(STEPS):
        write(storage, t)
    number = torch.arange(3.0)[:, None] + torch.arange(4.0) / 10
    torch.testing.assert_close(storage.task_rewards, number[..., None])
    torch.testing.assert_close(storage.observations["a"], number[..., None])
    torch.testing.assert_close(storage.actions_log_prob, number[..., None])
    torch.testing.assert_close(storage.action_mean, number[..., None].expand(3, 4, 2))
    assert storage.dones.squeeze(-1).int().tolist() == [[0] * 4, [0, 0, 0, 1], [1] * 4]
    assert storage.time_outs.squeeze(-1).int().tolist() == [[0] * 4, [0] * 4, [0, 0, 0, 1]]


def test_a_full_rollout_takes_no_more_until_it_is_cleared(storage):
    for t in range(STEPS):
        write(storage, t)
    with pytest.raises(OverflowError, match="clear"):
        write(storage, 3)
    storage.clear()
    write(storage, 3)
    assert storage.task_rewards[0, 0, 0] == 3.0


def test_shuffled_tensors_keep_their_rows_together(storage):
    number = torch.arange(STEPS * WORLDS).view(STEPS, WORLDS)
    data = {}
    storage.shuffle_into(data, a=number, b=10 * number[..., None])
    assert data["a"].sort().values.tolist() == list(range(12))
    assert data["a"].tolist() != list(range(12))
    assert torch.equal(data["b"].squeeze(1), 10 * data["a"])


def test_shuffled_tensors_stay_where_they_are(storage):
    data = {}
    storage.shuffle_into(data, a=torch.zeros(STEPS, WORLDS))
    first = data["a"]
    storage.shuffle_into(data, a=torch.ones(STEPS, WORLDS))
    assert data["a"] is first and first.tolist() == [1.0] * 12


def test_an_epoch_shows_every_row_once():
    data = {"a": torch.arange(12), "b": torch.arange(12) * 2}
    batches = list(mini_batches(data, count=4))
    assert [len(b["a"]) for b in batches] == [3] * 4
    assert torch.cat([b["a"] for b in batches]).tolist() == list(range(12))
    assert all(torch.equal(b["b"], 2 * b["a"]) for b in batches)
