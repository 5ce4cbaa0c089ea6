"""An output never takes the place of a file that the same command did not write."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from kiras_rl.tools.evaluation.report.files import PAGE, check_page
from kiras_rl.tools.export import main as export
from kiras_rl.tools.play import main as play
from kiras_rl.tools.shared.outputs import OutputError, check_output, save_arrays, save_figure


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.pdf", "a.svg"])
def test_a_picture_takes_the_place_of_the_one_before(name, tmp_path):
    for _ in range(2):
        save_figure(Figure(), tmp_path / name, "kiras-test --one")
    before = (tmp_path / name).read_bytes()
    with pytest.raises(OutputError, match="was not written by this command: name another file"):
        save_figure(Figure(), tmp_path / name, "kiras-test --two")
    assert (tmp_path / name).read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_arrays_take_the_place_of_the_ones_before(tmp_path):
    path = tmp_path / "a.npz"
    for count in (2, 3):
        save_arrays({"x": np.zeros(count)}, path, "kiras-test")
    assert np.load(path)["x"].shape == (3,)
    np.savez(path, x=np.zeros(1))
    with pytest.raises(OutputError):
        save_arrays({"x": np.zeros(2)}, path, "kiras-test")


def test_a_folder_is_no_place_for_a_file(tmp_path):
    with pytest.raises(OutputError, match="is a folder: name a file"):
        check_output(tmp_path, "kiras-test")


def test_a_trace_spares_an_input(still_file, tmp_path, capsys):
    mine = tmp_path / "mine.png"
    mine.write_bytes(b"a picture of mine")
    assert play([str(still_file), "--script=walk:1:0.3", "--trace", str(mine)]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith(f"error: {mine} is there and was not written by")
    assert mine.read_bytes() == b"a picture of mine"


def test_an_export_spares_what_is_no_policy_file(tmp_path, capsys):
    for name in ("latest.pt", "config.yaml"):
        (tmp_path / name).write_bytes(b"something else")
        assert export([str(tmp_path / "latest.pt"), "--out", str(tmp_path / name)]) == 2
        assert "is there and is no policy file" in capsys.readouterr().err
        assert (tmp_path / name).read_bytes() == b"something else"


def test_a_report_spares_tables_that_are_not_its_own(tmp_path):
    table = tmp_path / "tables" / "flat_errors.csv"
    table.parent.mkdir()
    table.write_text("mine")
    with pytest.raises(OutputError, match="was not written by this command"):
        check_page(tmp_path)
    (tmp_path / PAGE).write_text("<title>KiRAS: a policy</title>")  # which they belong to
    check_page(tmp_path)


def test_a_report_spares_another_page(tmp_path):
    check_page(tmp_path)
    (tmp_path / PAGE).write_text("<title>KiRAS: a policy</title>")
    check_page(tmp_path)
    (tmp_path / PAGE).write_text("<title>Mine</title>")
    with pytest.raises(OutputError):
        check_page(tmp_path)
