"""The base of all errors that a command tells in one line.

It stands here because a robot's computer has no more of the project than this folder.
"""

from __future__ import annotations


class PlainError(Exception):
    """What is given or asked for cannot be; the message says all that a user needs."""
