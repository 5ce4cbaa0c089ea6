"""The web server of MuJoCo Studio with what it lacks: a guard, and a channel for our own script."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from socket import socket
from typing import Any
from urllib.parse import urlsplit
from weakref import WeakKeyDictionary

from mujoco.studio.web import web_server
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from kiras_rl.tools.driving.viewer.cockpit import Cockpit
from kiras_rl.tools.driving.viewer.guard import is_allowed
from kiras_rl.tools.driving.viewer.keys import Keys
from kiras_rl.tools.driving.viewer.view import View

CHANNEL = "/drive"
"""Where the script page.js tells of keys and pictures."""

_SCRIPT = Path(__file__).with_name("page.js")
_PAGES = ("/", "/index.html")
_FORBIDDEN = 403


class Channel:
    """Hears what pages tell, and answers what to draw."""

    def __init__(self, cockpit: Cockpit, view: View) -> None:
        """Keep who is driven and what is looked at."""
        self._cockpit, self._view = cockpit, view

    async def listen(self, connection: ServerConnection) -> None:
        """Hear one page until it goes away."""
        keys = Keys(self._cockpit, self._view)
        try:
            async for text in connection:
                self._take(json.loads(text), keys)
                await connection.send(json.dumps({"share": self._view.detail.level.share}))
        except ConnectionClosed:
            pass
        finally:
            keys.release_all()

    def _take(self, message: dict[str, Any], keys: Keys) -> None:
        if "key" in message:
            act = keys.press if message["down"] else keys.release
            act(message["key"], message["at"] / 1000, time.monotonic())
        elif "pictures" in message:
            self._view.detail.judge(message["pictures"])
        else:
            keys.release_all()


_channels: WeakKeyDictionary[socket, Channel] = WeakKeyDictionary()


def attach(listening: socket, channel: Channel) -> None:
    """Let the server that will listen on a socket have a guard and a channel."""
    _channels[listening] = channel
    if not hasattr(web_server.serve, "__wrapped__"):  # once is enough
        web_server.serve = _complete(web_server.serve)


def _complete(serve: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(serve)
    def serve_ours(handle: Any, *, sock: socket, process_request: Any, **options: Any) -> Any:
        async def listen(connection: ServerConnection) -> None:
            ours = sock in _channels and _path(connection.request) == CHANNEL
            await (_channels[sock].listen(connection) if ours else handle(connection))

        def answer(connection: ServerConnection, request: Request) -> Response | None:
            if not is_allowed(request.headers.get("Host"), request.headers.get("Origin")):
                text = "This page answers its own scripts, by an address or name of its machine.\n"
                return connection.respond(_FORBIDDEN, text)
            if _path(request) == CHANNEL and "Upgrade" in request.headers:
                return None
            response = process_request(connection, request)
            return _with_script(response) if _path(request) in _PAGES else response

        return serve(listen, sock=sock, process_request=answer, **options)

    return serve_ours


def _path(request: Request | None) -> str:
    return urlsplit(request.path).path if request else ""


def _with_script(page: Response) -> Response:
    """Put our script before those of the page."""
    script = b"<head><script>" + _SCRIPT.read_bytes() + b"</script>"
    page.body = page.body.replace(b"<head>", script, 1)
    del page.headers["Content-Length"]
    page.headers["Content-Length"] = str(len(page.body))
    return page
