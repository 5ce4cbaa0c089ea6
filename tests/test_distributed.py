"""One process is a group of one: everything that ranks share is its own."""

from __future__ import annotations

import pytest
import torch

from kiras_rl import distributed
from kiras_rl.checkpoint import CheckpointError
from kiras_rl.distributed import from_main
from kiras_rl.tools.train import main


def test_alone_every_function_returns_what_it_is_given():
    values = torch.randn(3, 2)
    for function in (distributed.total, distributed.mean, distributed.gather):
        assert function(values) is values
    assert distributed.broadcast(values) is values
    assert distributed.any_rank(True) and not distributed.any_rank(False)
    scalars = {"Episode/falls": 3.0}
    assert distributed.mean_scalars(scalars, summed=("Episode/",)) is scalars
    assert distributed.gather_states(scalars) == [scalars]
    assert distributed.scatter_states([scalars]) is scalars
    assert (distributed.size(), distributed.rank(), distributed.core_share()) == (1, 0, 0)


def test_alone_an_error_is_raised_where_it_is_made():
    def fail():
        raise CheckpointError("no")

    assert from_main(lambda: 3) == 3
    with pytest.raises(CheckpointError, match="no"):
        from_main(fail)


def test_one_process_started_by_torchrun_makes_no_group(monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "1")
    with distributed.group():
        assert not torch.distributed.is_initialized()


def test_ranks_that_nobody_answers_end_with_one_line(monkeypatch, capsys):
    settings = {"WORLD_SIZE": "2", "RANK": "1", "MASTER_ADDR": "localhost", "MASTER_PORT": "1"}
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(distributed, "TIMEOUT", distributed.timedelta(seconds=1))
    assert main(["--cfg", "smoke"]) == 1
    err = capsys.readouterr().err
    assert "error: rank 1 of 2: another rank died or did not answer" in err
