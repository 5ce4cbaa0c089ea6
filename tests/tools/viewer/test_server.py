"""What the page's script tells arrives where it belongs."""

from __future__ import annotations

import json
import urllib.request

import pytest
from patience import patience
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.tools.driving.viewer.cockpit import YAW, Cockpit
from kiras_rl.tools.driving.viewer.live import open_page
from kiras_rl.tools.driving.viewer.server import CHANNEL


@pytest.fixture(scope="module")
def drive(still_file):
    """Serve a page; return its cockpit, its session and its address."""
    cockpit = Cockpit(OnboardPolicy(still_file))
    with open_page(cockpit) as (page, session):
        yield cockpit, session, page.url


def open_channel(url, **options):
    return connect(url.replace("http", "ws").rstrip("/") + CHANNEL, **options)


def tell(channel, **message):
    """Tell something; return the answer."""
    channel.send(json.dumps(message))
    return json.loads(channel.recv(timeout=patience()))


def test_the_page_carries_the_script(drive):
    with urllib.request.urlopen(drive[2], timeout=patience()) as page:
        text = page.read().decode()
    assert text.index('"/drive"') < text.index("web_client.js")
    assert text.rstrip().endswith("</html>")


def test_keys_drive_and_are_let_go_when_the_page_goes(drive):
    cockpit, _, url = drive
    with open_channel(url) as channel:
        tell(channel, key="3", down=True, at=10.0)
        tell(channel, key="3", down=False, at=12.0)
        tell(channel, key="A", down=True, at=13.0)
        for _ in range(10):
            cockpit.advance()
        assert cockpit.skill == 2
        assert cockpit.target[YAW] > 0.2
        tell(channel, released=True)
        cockpit.advance()
        assert cockpit.target[YAW] == 0.0


def test_a_page_with_slow_pictures_is_asked_for_fewer_pixels(drive):
    _, session, url = drive
    with open_channel(url) as channel:
        assert tell(channel, pictures=60.0) == {"share": 1.0}
        assert not session.view.detail.level.plain
        assert tell(channel, pictures=0.5) == {"share": 0.5}
        assert session.view.detail.level.plain


def test_the_channel_is_closed_to_strangers(drive):
    with pytest.raises(InvalidStatus, match="403"), open_channel(drive[2], origin="http://x.org"):
        pass
