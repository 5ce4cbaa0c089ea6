"""Which source runs, for the provenance of what it makes."""

from __future__ import annotations

import json
import subprocess
from importlib import metadata
from pathlib import Path

UNKNOWN = "unknown"


def source_commit(folder: Path | None = None) -> str:
    """Return the commit of the source that runs.

    Args:
        folder: The root of a checkout; None for the one that this file is in.

    Returns:
        Of a checkout its commit, with "-dirty" behind it where files were changed; of an
        installation from a repository what pip wrote down of it (PEP 610); else "unknown".
    """
    folder = folder or Path(__file__).resolve().parents[2]
    # Asked of site-packages, git would answer for a repository that the environment lies in.
    return _commit_of(folder) if (folder / "pyproject.toml").exists() else _installed_commit()


def _commit_of(checkout: Path) -> str:
    command = ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return UNKNOWN


def _installed_commit() -> str:
    try:
        origin = metadata.distribution("kiras-rl").read_text("direct_url.json")
    except metadata.PackageNotFoundError:
        return UNKNOWN
    commit = json.loads(origin or "{}").get("vcs_info", {}).get("commit_id", UNKNOWN)
    return commit[:12]
