"""Results that outlive an interrupted evaluation."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from filelock import FileLock

from kiras_rl.config import ConfigError
from kiras_rl.files import replacing

FILE = "results.json"


class ForeignResultsError(ConfigError):
    """A folder that holds the results of another policy."""


class Ledger:
    """A JSON file of results by key, written whole after each new one.

    The same command given again finds what is done and measures only what is missing. Several
    processes may add to one file.
    """

    def __init__(self, folder: Path, subject: dict) -> None:
        """Open or begin the results of a policy.

        Args:
            folder: Where the file is; made if it is missing.
            subject: What is measured; `sha256` tells policies apart.

        Raises:
            ConfigError: The folder holds the results of another policy, or an unreadable file.
        """
        self.path = folder / FILE
        self.content: dict = {"subject": subject, "results": {}}
        folder.mkdir(parents=True, exist_ok=True)
        self._keep({})

    @classmethod
    def beside(cls, folder: Path, subject: dict) -> Ledger:
        """Open the results in `folder`, or beside it where that holds those of another policy."""
        try:
            return cls(folder, subject)
        except ForeignResultsError:
            return cls(folder.with_name(f"{folder.name}_{subject['sha256'][:8]}"), subject)

    def _read(self) -> dict:
        """Return the results on file, those of other processes among them."""
        if not self.path.is_file():
            return {}
        subject = self.content["subject"]
        try:
            content = json.loads(self.path.read_text(encoding="utf-8"))
            mine = content["subject"]["sha256"] == subject["sha256"]
            results = dict(content["results"].items())
        except (ValueError, KeyError, TypeError, AttributeError):
            raise ConfigError(
                f"{self.path} holds no results of kiras-evaluate: name another folder with --out"
            ) from None
        if not mine:
            raise ForeignResultsError(
                f"{self.path} holds results of another policy ({content['subject']['label']}): "
                "name another folder with --out, or delete that one"
            )
        return results

    def __contains__(self, key: str) -> bool:
        """Return whether there is a result of a key."""
        return key in self.content["results"]

    def get(self, key: str, measure: Callable[[], dict | list]) -> dict | list:
        """Return the result of a key; measure and keep it where there is none yet.

        Args:
            key: Names the protocol and everything that the result depends on.
            measure: Gives plain values, ready for JSON.
        """
        if key not in self:
            # Through JSON, so that a result is the same whether it was measured or read.
            self._keep({key: json.loads(json.dumps(measure()))})
        return self.content["results"][key]

    def _keep(self, new: dict) -> None:
        """Add results to those on file, whole or not at all."""
        with FileLock(self.path.with_name(f".{FILE}.lock")):
            self.content["results"] = self._read() | new
            with replacing(self.path) as temporary:
                temporary.write_text(json.dumps(self.content, indent=1) + "\n", encoding="utf-8")
