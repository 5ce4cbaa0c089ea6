"""kiras-play, live: in a browser page, in a terminal, or on a picture of the page."""

from __future__ import annotations

import io
import os
import sys
import threading
import time
import webbrowser
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from PIL import Image
from PIL.PngImagePlugin import PngInfo

from kiras_rl.tools.driving.viewer import LOOPBACK
from kiras_rl.tools.driving.viewer.browser import open_browser
from kiras_rl.tools.driving.viewer.choices import newest_checkpoint
from kiras_rl.tools.driving.viewer.cockpit import FORWARD, Cockpit
from kiras_rl.tools.driving.viewer.detail import LEVELS, Detail, Level
from kiras_rl.tools.driving.viewer.page import Page
from kiras_rl.tools.driving.viewer.panel import Panel
from kiras_rl.tools.driving.viewer.server import Channel
from kiras_rl.tools.driving.viewer.session import Session
from kiras_rl.tools.driving.viewer.stage import Stage
from kiras_rl.tools.driving.viewer.terminal import Terminal, open_screen
from kiras_rl.tools.driving.viewer.view import View
from kiras_rl.tools.shared.outputs import check_output

if TYPE_CHECKING:
    from playwright.sync_api import ViewportSize

SCREENSHOT = "kiras-play --screenshot"
_WINDOW: ViewportSize = {"width": 1280, "height": 800}
_SLOW = 3.0  # pictures a second that a browser without a GPU can draw
_QUALITY = 88  # of a JPEG: small, and the letters stay clear


@contextmanager
def open_page(
    cockpit: Cockpit,
    host: str = LOOPBACK,
    port: int = 0,
    follow: Path | None = None,
    rate: float = 60.0,
    levels: Sequence[Level] = LEVELS,
) -> Iterator[tuple[Page, Session]]:
    """Serve a cockpit as a page; the session is there to be run.

    Args:
        cockpit: What is driven.
        host: Address to listen on.
        port: Port to listen on; 0 takes a free one.
        follow: Run whose checkpoints are loaded as they appear.
        rate: Most pictures a second.
        levels: How much may be drawn, from most to least; later ones where pictures are slow.

    Raises:
        PageError: If the address or the port cannot be had.
        PolicyError: If what is to be followed is not a run.
    """
    view = View(detail=Detail(levels))
    stage = Stage(cockpit.driver)
    page = Page(Panel(cockpit, view), Channel(cockpit, view), host, port, rate)

    def show() -> None:
        nonlocal stage
        stage = stage.move_to(cockpit.driver, view.detail.level.plain)
        stage.pose(view.side)
        page.show(stage)
        page.check()

    try:
        yield page, Session(cockpit, show, view, follow)
    finally:
        page.close()


def drive_page(cockpit: Cockpit, host: str, port: int, browse: bool, follow: Path | None) -> None:
    """Serve a cockpit until Ctrl-C.

    Args:
        cockpit: What is driven.
        host: Address to listen on.
        port: Port to listen on; 0 takes a free one.
        browse: Whether to open a browser here, where there is a display.
        follow: Run whose checkpoints are loaded as they appear.

    Raises:
        PageError: If the address or the port cannot be had.
        PolicyError: If what is to be followed is not a run.
    """
    with open_page(cockpit, host, port, follow) as (page, session):
        print(f"driving {cockpit.title}: {page.url} ({_who(host)}); Ctrl-C ends", flush=True)
        if browse and _has_display():
            threading.Thread(target=webbrowser.open, args=(page.url,), daemon=True).start()
        try:
            session.run()
        except KeyboardInterrupt:
            print()


def drive_terminal(cockpit: Cockpit, follow: Path | None) -> None:
    """Drive with the keys of a terminal until X or Ctrl-C.

    Raises:
        TerminalError: If there is no terminal.
        PolicyError: If what is to be followed is not a run.
    """
    view = View()
    with open_screen() as screen:
        terminal = Terminal(screen, cockpit, view)

        def show() -> None:
            terminal.refresh()
            if terminal.leaving:
                session.close()

        session = Session(cockpit, show, view, follow)
        with suppress(KeyboardInterrupt):
            session.run()


def save_screenshot(cockpit: Cockpit, path: Path, speed: float) -> None:
    """Walk in three skills, one after the other, and take a picture of the page.

    Args:
        cockpit: What is driven.
        path: Picture to write.
        speed: Forward velocity, m/s.

    Raises:
        BrowserError: If there is no Chromium, or the package that steers it is missing.
    """
    check_output(path, SCREENSHOT)
    with (
        open_browser() as browser,
        open_page(cockpit, rate=_SLOW, levels=LEVELS[:1]) as (
            page,
            session,
        ),
    ):
        loop = threading.Thread(target=session.run, daemon=True)
        loop.start()
        tab = browser.new_page(viewport=_WINDOW)
        tab.goto(page.url)
        time.sleep(12.0)  # without a GPU the first picture takes this long
        cockpit.post(cockpit.set_target, FORWARD, speed)
        for skill in (1, 3):
            time.sleep(2.5)
            cockpit.post(cockpit.choose_skill, skill % len(cockpit.skills))
        time.sleep(2.0)
        cockpit.post(cockpit.toggle_pause)
        time.sleep(6.0)  # for the last state to be drawn
        picture = tab.screenshot(timeout=60_000)
        session.close()
        loop.join()
    about = PngInfo()
    about.add_text("Software", SCREENSHOT)
    is_png = path.suffix == ".png"
    marks: dict[str, Any] = {"pnginfo": about} if is_png else {"comment": SCREENSHOT.encode()}
    with Image.open(io.BytesIO(picture)) as image:
        image.convert("RGB").save(path, quality=_QUALITY, optimize=True, **marks)


def wait_for_checkpoint(run: Path) -> Path:
    """Return the newest checkpoint of a run, waiting for its first.

    Raises:
        PolicyError: If the path is not the folder of one run.
    """
    waiting = False
    while (checkpoint := newest_checkpoint(run)) is None:
        if not waiting:
            print(f"waiting for the first checkpoint of {run}", flush=True)
        waiting = True
        time.sleep(1.0)
    return checkpoint


def _who(host: str) -> str:
    if host in (LOOPBACK, "localhost", "::1"):
        return "this machine only; --host 0.0.0.0 lets others in"
    return "whoever reaches this port can drive: there is no password"


def _has_display() -> bool:
    linux = sys.platform.startswith("linux")
    return not linux or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
