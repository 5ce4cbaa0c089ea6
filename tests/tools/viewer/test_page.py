"""The page in a real headless Chromium; what happens is asserted on the host."""

from __future__ import annotations

import io
import threading
import time
import urllib.request

import numpy as np
import pytest
from patience import patience
from PIL import Image
from websockets.sync.client import connect

from kiras_rl.tools.driving.viewer import browser as browsers
from kiras_rl.tools.driving.viewer.cockpit import Cockpit
from kiras_rl.tools.driving.viewer.live import open_page
from kiras_rl.tools.shared.policy_files import load_policy

pytestmark = pytest.mark.slow  # a browser that draws on the CPU takes all there is of it

SIZE = {"width": 480, "height": 320}  # drawn on the CPU: the fewer pixels, the sooner
FRAMES = 8.0  # pictures a second, which a browser without a GPU keeps up with


@pytest.fixture(scope="module")
def drive():
    """Serve the shipped policy; return its cockpit and the page's address."""
    cockpit = Cockpit(load_policy(None))
    with open_page(cockpit, rate=FRAMES) as (page, session):
        loop = threading.Thread(target=session.run)
        loop.start()
        yield cockpit, page.url
        session.close()
        loop.join()


@pytest.fixture(scope="module")
def browser(drive):
    """Start a browser, which leaves before the page does."""
    try:
        browsers.find_chromium()
    except browsers.BrowserError as error:
        pytest.skip(str(error))
    with browsers.open_browser() as browser:
        yield browser


@pytest.fixture(scope="module")
def tab(browser, drive):
    """Open the page, and press a key at once."""
    cockpit, url = drive
    tab = browser.new_page(viewport=SIZE)
    tab.goto(url)
    choose(cockpit, tab, "2")
    return tab


def wait_for(condition):
    end = time.monotonic() + patience()
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.02)
    return True


def press(tab, key, condition):
    """Press a key once, as short as can be: none is lost, however slow the pictures are."""
    tab.keyboard.press(key)
    assert wait_for(condition), f"pressing {key} did nothing"


def choose(cockpit, tab, key):
    press(tab, key, lambda: cockpit.skill == int(key) - 1)
    return cockpit.driver.posture.base_height


def mean_of_last(cockpit, column, seconds=0.5):
    values = cockpit.telemetry.view()[column]
    return values[-round(seconds * 50) :].mean()


def stands_at(cockpit, height):
    return lambda: abs(mean_of_last(cockpit, "base_height") - height) < 0.02


def test_the_page_is_served_on_loopback_alone(drive):
    _, url = drive
    assert url.startswith("http://127.0.0.1:")
    assert b"<canvas" in urllib.request.urlopen(url, timeout=patience()).read()


@pytest.mark.parametrize(("key", "skill"), [("3", "stilt"), ("2", "crawl")])
def test_a_skills_key_brings_the_base_to_its_keyframe(drive, tab, key, skill):
    cockpit, _ = drive
    choose(cockpit, tab, key)
    assert cockpit.skills[cockpit.skill] == skill
    height = cockpit.driver.metadata.keyframes[skill].base_height
    assert wait_for(stands_at(cockpit, height))


def test_a_held_key_walks_and_space_stops(drive, tab):
    cockpit, _ = drive
    choose(cockpit, tab, "1")
    tab.keyboard.down("w")
    assert wait_for(lambda: cockpit.target[0] > 0.4)  # fast enough for it to walk at all
    tab.keyboard.up("w")
    assert wait_for(lambda: mean_of_last(cockpit, "lin_vel_x") > 0.15)
    press(tab, "Space", lambda: not cockpit.target.any())
    assert wait_for(lambda: abs(mean_of_last(cockpit, "lin_vel_x")) < 0.05)


def test_a_push_is_felt_and_survived(drive, tab):
    cockpit, _ = drive
    height = choose(cockpit, tab, "1")
    assert wait_for(stands_at(cockpit, height))
    falls, pushes = cockpit.falls, cockpit.pushes
    press(tab, "p", lambda: cockpit.pushes > pushes)
    time.sleep(1.0)
    assert wait_for(stands_at(cockpit, height))
    assert wait_for(lambda: abs(mean_of_last(cockpit, "lin_vel_x")) < 0.05)
    assert cockpit.falls == falls


def test_many_keys_between_two_pictures_all_act(drive, tab):
    cockpit, _ = drive
    pushes = cockpit.pushes
    for key in "ppp3":
        tab.keyboard.press(key)
    assert wait_for(lambda: cockpit.skill == 2)
    assert cockpit.pushes == pushes + 3


def test_the_picture_is_not_blank(tab):
    """Panel, sky, ground and robot: the middle, where there is no panel, has its own contrasts."""
    picture = np.asarray(
        Image.open(io.BytesIO(tab.screenshot(timeout=1000 * patience()))).convert("L")
    )
    assert picture.std() > 20
    assert picture[100:220, 180:300].std() > 5


def test_a_key_changes_the_ground_and_the_page_goes_on(drive, tab):
    cockpit, _ = drive
    press(tab, "f", lambda: not cockpit.tile.is_flat)
    press(tab, "l", lambda: cockpit.tile.level > 0)
    choose(cockpit, tab, "2")


def test_a_second_viewer_watches_and_closing_the_tab_ends_nothing(drive, tab):
    """The second one speaks as a tab does but draws nothing: two would starve each other here."""
    cockpit, url = drive
    with connect(f"{url.replace('http', 'ws')}state?sid=second") as second:
        received = [second.recv(timeout=patience()) for _ in range(20)]
        roles = [message for message in received if "role=" in str(message)]
        assert "viewers=2;role=spectator" in roles[-1]
        assert len({message for message in received if isinstance(message, bytes)}) > 5
    tab.close()
    before = cockpit.driver.time
    time.sleep(1.0)
    assert cockpit.driver.time > before + 0.5
