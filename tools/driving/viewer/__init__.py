"""Driving a simulated robot by hand: in a browser page, in a terminal."""

from kiras_rl.deploy.errors import PlainError

LOOPBACK = "127.0.0.1"
"""Where the page listens unless it is told otherwise: this machine alone reaches it."""

DEFAULT_PORT = 8017


class LiveError(PlainError, RuntimeError):
    """There is no page, terminal or browser to drive in; the text says why."""
