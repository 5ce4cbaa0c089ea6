"""The commit that a run writes down is that of the source, and of nothing around it."""

from __future__ import annotations

import json
import subprocess

import pytest

from kiras_rl.tools.shared.source import source_commit

COMMIT = "0123456789abcdef0123456789abcdef01234567"


def git(folder, *arguments):
    identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
    done = subprocess.run(
        ["git", "-C", str(folder), *identity, *arguments],
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.strip()


@pytest.fixture
def checkout(tmp_path):
    """A repository of one commit."""
    (tmp_path / "pyproject.toml").write_text("")
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "--message", "begin")
    return tmp_path


@pytest.fixture
def installed(tmp_path_factory, monkeypatch):
    """Record an installation as pip does, with where it came from."""
    site = tmp_path_factory.mktemp("site")
    record = site / "kiras_rl-0.1.0.dist-info"
    record.mkdir()
    (record / "METADATA").write_text("Name: kiras-rl\nVersion: 0.1.0\n")
    monkeypatch.syspath_prepend(site)
    return lambda origin: (record / "direct_url.json").write_text(json.dumps(origin))


def test_a_checkout_says_its_commit_and_whether_it_was_changed(checkout):
    commit = git(checkout, "rev-parse", "HEAD")[:12]
    assert source_commit(checkout) == commit
    (checkout / "pyproject.toml").write_text("[project]")
    assert source_commit(checkout) == commit + "-dirty"


def test_an_installation_does_not_say_the_commit_of_a_repository_around_it(checkout, installed):
    site = checkout / ".venv" / "site-packages"
    site.mkdir(parents=True)
    assert source_commit(site) == "unknown"
    installed({"url": "file:///a/wheel.whl", "archive_info": {}})
    assert source_commit(site) == "unknown"


def test_an_installation_from_a_repository_says_what_pip_wrote_down(tmp_path, installed):
    installed({"url": "https://a/b.git", "vcs_info": {"vcs": "git", "commit_id": COMMIT}})
    assert source_commit(tmp_path) == COMMIT[:12]


def test_a_folder_that_is_no_repository_has_an_unknown_commit(tmp_path):
    (tmp_path / "pyproject.toml").write_text("")
    assert source_commit(tmp_path) == "unknown"
