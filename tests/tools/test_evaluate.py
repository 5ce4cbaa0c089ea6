"""kiras-evaluate on the policy that comes with Solo-8, with few robots."""

from __future__ import annotations

import json

import pytest

from kiras_rl.tools.evaluate import main


def test_the_imitation_protocol_measures_the_shipped_policy(tmp_path, capsys):
    path = tmp_path / "imitation.json"
    assert main(["--protocol", "imitation", "--robots", "2", "--json", str(path)]) == 0
    printed = capsys.readouterr().out
    for title in ("imitation: 2 robots a skill, 120 steps", "gait", "nearest keyframe"):
        assert title in printed
    imitation = json.loads(path.read_text())["imitation"]
    assert list(imitation["skills"]) == ["walk", "crawl", "stilt", "pitch_up", "pitch_down"]
    for result in imitation["skills"].values():
        assert result["falls"] == 0.0
        assert result["dtw"] == pytest.approx(120 * result["dtw_frame"])
        assert 0.05 < result["dtw_frame"] < 0.6  # it moves its legs around the keyframe
        assert result["accuracy"] > 0.95 and result["cosine"] > 0.95
        assert result["height_error"] < 0.02
        assert 3.0 < result["frequency"] < 8.0
        assert 0.002 < result["clearance"] < 0.05
        assert 1.0 < result["power"] < 15.0


@pytest.mark.parametrize("option", ["--robots", "--trials"])
@pytest.mark.parametrize("value", ["0", "-3", "many"])
def test_a_number_that_cannot_be_is_refused(option, value, capsys):
    with pytest.raises(SystemExit) as exit_info:
        main([f"{option}={value}"])
    assert exit_info.value.code == 2
    assert f"'{value}': give a number of at least 1" in capsys.readouterr().err
