"""The live page answers its own scripts alone."""

from __future__ import annotations

import socket
import urllib.error
import urllib.request

import pytest

from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.tools.driving.viewer.cockpit import Cockpit
from kiras_rl.tools.driving.viewer.guard import is_allowed
from kiras_rl.tools.driving.viewer.live import open_page


@pytest.mark.parametrize(
    ("host", "origin", "allowed"),
    [
        ("127.0.0.1:8017", None, True),
        ("127.0.0.1:8017", "http://127.0.0.1:8017", True),
        ("localhost:9000", "http://localhost:9000", True),  # through ssh -L 9000:localhost:8017
        ("[::1]:8017", "http://[::1]:8017", True),
        ("192.168.0.7:8017", "http://192.168.0.7:8017", True),
        (f"{socket.gethostname()}:8017", None, True),
        ("127.0.0.1:8017", "https://evil.example", False),
        ("127.0.0.1:8017", "http://127.0.0.1:3000", False),
        ("127.0.0.1:8017", "null", False),
        ("evil.example:8017", "http://evil.example:8017", False),  # a name that points here
        ("evil.example:8017", None, False),
        (None, None, False),
    ],
)
def test_who_is_let_in(host, origin, allowed):
    assert is_allowed(host, origin) is allowed


def status(url, **headers):
    """Return the status with which a page answers."""
    try:
        with urllib.request.urlopen(
            urllib.request.Request(url, headers=headers), timeout=60
        ) as page:
            return page.status
    except urllib.error.HTTPError as error:
        with error:
            return error.code


def test_the_page_refuses_strangers(still_file):
    with open_page(Cockpit(OnboardPolicy(still_file))) as (page, _):
        assert status(page.url) == 200
        assert status(page.url, Origin=page.url.rstrip("/")) == 200
        assert status(page.url, Origin="https://evil.example") == 403
        assert status(page.url, Host="evil.example:80") == 403
