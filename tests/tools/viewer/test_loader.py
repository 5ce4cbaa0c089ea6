"""What can be chosen, what is newest, and policies that arrive while another one drives."""

from __future__ import annotations

import os
import shutil
import threading
import time

import pytest
from patience import patience

from kiras_rl.checkpoint import save_checkpoint
from kiras_rl.deploy.policy import OnboardPolicy, PolicyError
from kiras_rl.tools.driving.viewer.choices import list_choices, newest_checkpoint, title_of
from kiras_rl.tools.driving.viewer.cockpit import Cockpit
from kiras_rl.tools.driving.viewer.loader import Follower, Loader
from kiras_rl.tools.driving.viewer.session import Session
from kiras_rl.tools.driving.viewer.view import View


@pytest.fixture
def run(tmp_path):
    """A run folder that has just begun."""
    folder = tmp_path / "runs" / "solo8" / "2026-01-02_10-00-00"
    (folder / "checkpoints").mkdir(parents=True)
    (folder / "config.yaml").touch()
    return folder


def write(run, name, when, content=b""):
    path = run / "checkpoints" / name
    path.write_bytes(content)
    os.utime(path, (when, when))
    return path


def wait_for(loader):
    end = time.monotonic() + patience()
    while time.monotonic() < end:
        if loaded := loader.poll():
            return loaded
        time.sleep(0.01)
    raise AssertionError("nothing was loaded")


def test_shipped_policies_come_first_then_runs_the_newest_first(tmp_path, run, still_file):
    older = tmp_path / "runs" / "quick" / "2026-01-01_10-00-00"
    empty = tmp_path / "runs" / "quick" / "2026-01-03_10-00-00"
    for folder in (older, empty):
        folder.mkdir(parents=True)
        (folder / "config.yaml").touch()
    write(run, "latest.pt", 1)
    shutil.copy(still_file, older / "policy.onnx")
    titles = [choice.title for choice in list_choices(tmp_path / "runs")]
    assert titles[:3] == ["go1: flat", "solo8: flat", "solo8: rough"]
    assert titles[-2:] == ["solo8/2026-01-02_10-00-00", "quick/2026-01-01_10-00-00"]


def test_robots_without_a_policy_are_not_offered(tmp_path, monkeypatch, still_file):
    for robot in ("bare", "able"):
        (tmp_path / robot / "policies").mkdir(parents=True)
    shutil.copy(still_file, tmp_path / "able/policies/still.onnx")
    monkeypatch.setattr("kiras_rl.tools.driving.viewer.choices.ROBOTS", tmp_path)
    monkeypatch.setattr(
        "kiras_rl.tools.driving.viewer.choices.list_robots", lambda: ["able", "bare"]
    )
    assert [choice.title for choice in list_choices(tmp_path / "runs")] == ["able: still"]


def test_a_choice_is_called_by_robot_file_or_run(run, still_file):
    assert title_of(run) == "solo8/2026-01-02_10-00-00"
    assert title_of(still_file) == "still.onnx"


def test_the_newest_checkpoint_is_the_one_written_last(run):
    assert newest_checkpoint(run) is None
    best = write(run, "best.pt", 100)
    latest = write(run, "latest.pt", 200)
    assert newest_checkpoint(run) == latest
    write(run, "best.pt", 300)
    assert newest_checkpoint(run) == best


def test_only_a_run_can_be_followed(tmp_path):
    with pytest.raises(PolicyError, match=r"only a run can be followed, such as .*, not "):
        newest_checkpoint(tmp_path)


def test_a_follower_tells_each_checkpoint_once(run):
    now = [0.0]
    write(run, "latest.pt", 100)
    follower = Follower(run, lambda: now[0])
    now[0] = 10.0
    assert follower.poll() is None  # it was there before
    latest = write(run, "latest.pt", 200)
    now[0] = 20.0
    assert follower.poll() == latest
    now[0] = 30.0
    assert follower.poll() is None


def test_a_policy_arrives_in_the_background(still_file):
    loader = Loader()
    loader.request(still_file, "still")
    loaded = wait_for(loader)
    assert (loaded.title, loaded.policy.metadata.robot) == ("still", "solo8")
    assert loader.poll() is None
    loader.close()


def test_of_waiting_requests_the_last_counts(still_file, tmp_path):
    loader = Loader()
    loader.request(tmp_path / "gone.onnx", "first")
    loader.request(still_file, "second")
    assert wait_for(loader).title == "second"
    loader.close()


def test_what_cannot_be_loaded_is_said(tmp_path):
    (tmp_path / "a.onnx").write_text("a letter")
    (tmp_path / "a.pt").write_text("a letter")
    loader = Loader()
    for name, reason in (("a.onnx", "is not an ONNX file"), ("a.pt", "is not a whole KiRAS")):
        loader.request(tmp_path / name, name)
        loaded = wait_for(loader)
        assert loaded.policy is None
        assert reason in loaded.error
        assert "\n" not in loaded.error
    loader.close()


def test_choosing_a_policy_changes_what_drives(still_file, exported, tmp_path):
    run = tmp_path / "runs" / "solo8" / "now"
    run.mkdir(parents=True)
    (run / "config.yaml").touch()
    shutil.copy(exported[2], run / "policy.onnx")
    cockpit, view = Cockpit(OnboardPolicy(still_file)), View()
    session = Session(cockpit, lambda: None, view, runs=tmp_path / "runs")
    selector = view.selectors[0]
    selector.choose(selector.options().index("solo8/now"))
    session.run(seconds=2.0)
    assert selector.current() == cockpit.title == "solo8/now"
    assert cockpit.notice.startswith("loaded at ")


def test_a_followed_run_gives_its_newest_policy_to_the_running_robot(
    run, still_file, make_metadata, make_policy
):
    """The checkpoint is a real one; a policy without an estimator tells itself from the first."""
    metadata, networks = make_metadata(), make_policy(make_metadata(), gain=0.0, estimator=False)
    cockpit = Cockpit(OnboardPolicy(still_file))
    session = Session(cockpit, lambda: None, View(), follow=run, runs=run)
    save_checkpoint(
        run / "checkpoints" / "latest.pt",
        {
            "learner": {},
            "policy_shape": networks.shape(),
            "policy": networks.state_dict(),
            "description": metadata.to_dict(),
        },
    )
    end = time.monotonic() + patience()
    loop = threading.Thread(target=session.run)
    loop.start()
    while not (cockpit.notice and cockpit.driver.time > 1.0) and time.monotonic() < end:
        time.sleep(0.1)
    session.close()
    loop.join()
    assert cockpit.notice.startswith("loaded at ")
    assert cockpit.title == "solo8/2026-01-02_10-00-00"
    assert not cockpit.driver.policy.velocity.any()
    assert cockpit.driver.time > 1.0  # it goes on


def test_a_session_keeps_real_time_and_slows_down(still_file):
    cockpit = Cockpit(OnboardPolicy(still_file))
    Session(cockpit, lambda: None, View()).run(seconds=1.0)
    assert cockpit.driver.time == pytest.approx(1.0, abs=0.2)
    cockpit.set_speed(0.25)
    shown = []
    Session(cockpit, lambda: shown.append(1), View()).run(seconds=1.0)
    assert cockpit.driver.time == pytest.approx(1.25, abs=0.3)
    assert len(shown) > 2 * 50 * 0.25  # it is shown between control steps
