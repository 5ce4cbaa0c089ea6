"""The browser page: MuJoCo Studio's web viewer with one panel of our own, bound where we say."""

from __future__ import annotations

import contextlib
import errno
import io
import logging
import socket
import threading
import time

import mujoco
import numpy as np
from mujoco.studio import endpoints, launch_thread, messages, viewer_protocol, web_viewer

from kiras_rl.tools.driving.viewer import LOOPBACK, LiveError, server
from kiras_rl.tools.driving.viewer.panel import Panel
from kiras_rl.tools.driving.viewer.stage import Stage

_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_START_SECONDS = 30.0


class PageError(LiveError):
    """The page cannot be served; the text says why."""


class Page:
    """Serves one stage to browsers, from a thread of its own.

    The first tab drives, others watch; without any the simulation goes on.

    Attributes:
        url: Where a browser on this machine finds it.
    """

    def __init__(
        self,
        panel: Panel,
        channel: server.Channel,
        host: str = LOOPBACK,
        port: int = 0,
        rate: float = 60.0,
    ) -> None:
        """Start to serve.

        Args:
            panel: What is drawn over the scene.
            channel: What hears keys.
            host: Address to listen on.
            port: Port to listen on; 0 takes a free one.
            rate: Most pictures a second; a browser that draws fewer falls behind by and by.

        Raises:
            PageError: If the address or the port cannot be had.
        """
        port = _free_port(host, port)
        self.url = f"http://{_reachable(host)}:{port}/"
        self._stage: Stage | None = None
        self._panel, self._channel = panel, channel
        self._viewer_end, self._end = launch_thread.make_thread_endpoints()
        self._ready = threading.Event()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._serve, args=(host, port, rate), daemon=True)
        self._thread.start()
        if not self._ready.wait(_START_SECONDS) or self._failure:
            raise PageError(f"the page could not be served at {self.url}: {self._failure}")
        _wait_until_open(_reachable(host).strip("[]"), port)

    def show(self, stage: Stage) -> None:
        """Send the stage as it stands; a new one makes browsers load its model."""
        if stage is not self._stage:
            self._stage = stage
            self._end.send_to_viewer(messages.ModelEvent(model=stage.model))
        state = np.empty(mujoco.mj_stateSize(stage.model, _STATE))
        mujoco.mj_getState(stage.model, stage.data, state, _STATE)
        self._end.send_to_viewer(messages.StateSnapshot(state=state, state_sig=_STATE))

    def check(self) -> None:
        """Raise what ended the page, if something did.

        Raises:
            PageError: If it is not served any more.
        """
        if not self._thread.is_alive():
            raise PageError(f"the page at {self.url} has ended: {self._failure}")

    def close(self) -> None:
        """Stop serving."""
        self._end.send_to_viewer(messages.ExitEvent())
        self._thread.join(5.0)
        self._end.close()

    def _serve(self, host: str, port: int, rate: float) -> None:
        logging.getLogger("WebServer").setLevel(logging.WARNING)  # who comes and goes
        try:
            with contextlib.redirect_stdout(io.StringIO()):  # its banner; ours is one line
                viewer = _Viewer(host, port, rate, self._viewer_end, self._panel, self._channel)
            self._ready.set()
            viewer_protocol.run_viewer_loop(viewer)
        except BaseException as error:  # given to the thread that asks
            self._failure = error
            self._ready.set()


class _Viewer(web_viewer.WebViewer):
    """Studio's web viewer on an address of our choice, quiet when the model changes."""

    def __init__(
        self,
        host: str,
        port: int,
        rate: float,
        endpoint: endpoints.ViewerEndpoint,
        panel: Panel,
        channel: server.Channel,
    ) -> None:
        self._channel = channel
        self._chosen_host, self._period, self._last = host, 1 / rate, 0.0
        config = viewer_protocol.ViewerConfig(title="KiRAS", gfx="web", http_port=port)
        super().__init__(config, endpoint, plugins=[panel])

    @property
    def _host(self) -> str:
        return self._chosen_host

    @_host.setter
    def _host(self, _: str) -> None:
        """Drop what the base class asks for: all interfaces."""

    def _start_server(self) -> None:
        server.attach(self._http_sock, self._channel)
        super()._start_server()

    def prepare_next_frame(self) -> bool:
        """Start a picture when a browser wants one, and not before its time."""
        wanted = super().prepare_next_frame()
        if wanted:
            time.sleep(max(0.0, self._last + self._period - time.monotonic()))
            self._last = time.monotonic()
        return wanted

    @messages.handler(priority=messages.Priority.INTERNAL)
    def _on_post_model(self, event: messages.PostModelEvent) -> None:
        self._update_model()


def _free_port(host: str, port: int) -> int:
    """Check that a port can be had, and choose one if it is 0."""
    if not 0 <= port <= 65535:
        raise PageError(f"--port is a number from 0 to 65535, not {port}")
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
            probe.listen()
            return probe.getsockname()[1]
    except UnicodeError:
        raise PageError(f"--host {host} is no name of a machine") from None
    except OSError as error:
        if isinstance(error, socket.gaierror) or error.errno != errno.EADDRINUSE:
            raise PageError(f"cannot listen on --host {host}: {error.strerror}") from None
        raise PageError(
            f"port {port} is taken, perhaps by another kiras-play: name another one with "
            "--port, or 0 for any free one"
        ) from None


def _wait_until_open(host: str, port: int) -> None:
    """Wait for the server's thread to listen: whoever is told the address may come at once."""
    end = time.monotonic() + _START_SECONDS
    while True:
        try:
            socket.create_connection((host, port), timeout=1.0).close()
            return
        except OSError:
            if time.monotonic() > end:
                raise PageError(f"nothing answers at port {port} of {host}") from None
            time.sleep(0.02)


def _reachable(host: str) -> str:
    """Return the name under which a browser on this machine reaches what listens on a host."""
    if host in ("0.0.0.0", "::", ""):
        return "localhost"
    return f"[{host}]" if ":" in host else host
