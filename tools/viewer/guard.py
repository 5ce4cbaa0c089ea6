"""Who may talk to the page: its own scripts, under a name of this machine.

Another site's page that is open in the same browser reaches this machine's ports, too. A browser
tells where a request is from (Origin) and whom it means (Host); a site that points a name of its
own at this machine is told by the latter.
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Callable
from functools import cache, wraps
from typing import Any
from urllib.parse import urlsplit

from mujoco.studio.web import web_server

_FORBIDDEN = 403


def install() -> None:
    """Let the web server of MuJoCo Studio ask `is_allowed` first; once is enough."""
    if not hasattr(web_server.serve, "__wrapped__"):
        web_server.serve = _guarded(web_server.serve)


def is_allowed(host: str | None, origin: str | None) -> bool:
    """Tell whether a request may be answered.

    Args:
        host: The header Host: whom the request means, with its port.
        origin: The header Origin: whose page asks; None where no page does.
    """
    if not host or (urlsplit(f"//{host}").hostname not in _names() and not _is_address(host)):
        return False
    return origin is None or urlsplit(origin).netloc == host


@cache
def _names() -> frozenset[str]:
    return frozenset({"localhost", socket.gethostname().lower(), socket.getfqdn().lower()})


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(urlsplit(f"//{host}").hostname or "")
    except ValueError:
        return False
    return True


def _guarded(serve: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(serve)
    def serve_own(*args: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        def ask_first(connection: Any, request: Any) -> Any:
            if is_allowed(request.headers.get("Host"), request.headers.get("Origin")):
                return process_request(connection, request)
            text = "This page answers its own scripts, by an address or name of its machine.\n"
            return connection.respond(_FORBIDDEN, text)

        return serve(*args, process_request=ask_first, **options)

    return serve_own
