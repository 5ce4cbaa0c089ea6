"""Who may talk to the page: its own scripts, under a name of this machine.

Another site's page that is open in the same browser reaches this machine's ports, too. A browser
tells where a request is from (Origin) and whom it means (Host); a site that points a name of its
own at this machine is told by the latter.
"""

from __future__ import annotations

import ipaddress
import socket
from functools import cache
from urllib.parse import urlsplit


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
