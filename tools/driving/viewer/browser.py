"""A headless Chromium for pictures and tests of the page."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from kiras_rl.tools.driving.viewer import LiveError

if TYPE_CHECKING:
    from playwright.sync_api import Browser

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
"""Programs that do, in the order in which they are looked for."""

# WebGL on the CPU, and as root, which is what containers are
_ARGUMENTS = (
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)


class BrowserError(LiveError):
    """No browser that can be used without a screen; the text says what to install."""


def find_chromium() -> str:
    """Return the path of a Chromium.

    Raises:
        BrowserError: If there is none.
    """
    for name in NAMES:
        if path := shutil.which(name):
            return path
    raise BrowserError(f"none of {', '.join(NAMES)} is installed (`apt-get install -y chromium`)")


@contextmanager
def open_browser() -> Iterator[Browser]:
    """Start a headless Chromium.

    Raises:
        BrowserError: If it, or the package that steers it, is missing.
    """
    program = find_chromium()
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        raise BrowserError(
            "steering a browser needs one more package: pip install playwright"
        ) from None
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=list(_ARGUMENTS))
        try:
            yield browser
        finally:
            browser.close()
