"""Results that outlive an interrupted evaluation."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

from kiras_rl.config import ConfigError

FILE = "results.json"


class Ledger:
    """A JSON file of results by key, written whole after each new one.

    The same command given again finds what is done and measures only what is missing.
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
        if self.path.is_file():
            self.content = self._read(subject)
        folder.mkdir(parents=True, exist_ok=True)

    def _read(self, subject: dict) -> dict:
        try:
            content = json.loads(self.path.read_text(encoding="utf-8"))
            mine = content["subject"]["sha256"] == subject["sha256"]
            _ = content["results"].items()
        except (ValueError, KeyError, TypeError, AttributeError):
            raise ConfigError(
                f"{self.path} holds no results of kiras-evaluate: name another folder with --out"
            ) from None
        if not mine:
            raise ConfigError(
                f"{self.path} holds results of another policy ({content['subject']['label']}): "
                "name another folder with --out, or delete that one"
            )
        return content

    def __contains__(self, key: str) -> bool:
        """Return whether there is a result of a key."""
        return key in self.content["results"]

    def get(self, key: str, measure: Callable[[], dict | list]) -> dict | list:
        """Return the result of a key; measure and keep it where there is none yet.

        Args:
            key: Names the protocol and everything that the result depends on.
            measure: Gives plain values, ready for JSON.
        """
        results = self.content["results"]
        if key not in results:
            # Through JSON, so that a result is the same whether it was measured or read.
            results[key] = json.loads(json.dumps(measure()))
            self._write()
        return results[key]

    def _write(self) -> None:
        temporary = self.path.with_name(f".{FILE}.{os.getpid()}")
        temporary.write_text(json.dumps(self.content, indent=1) + "\n", encoding="utf-8")
        temporary.replace(self.path)
