"""The panel over the scene: skills, velocities, time, choices, plots; and its keys."""

from __future__ import annotations

import mujoco
import numpy as np
from mujoco.studio import messages, plugin, ux
from mujoco.studio.dear_imgui import dear_imgui as imgui

from kiras_rl.tools.driving.viewer import bindings, widgets
from kiras_rl.tools.driving.viewer.cockpit import AXES, FORWARD, LEFT, SPEEDS, YAW, Cockpit
from kiras_rl.tools.driving.viewer.plots import ESTIMATE, MEASURED, TARGET, Line, draw_plot
from kiras_rl.tools.driving.viewer.stage import GHOST_GROUP
from kiras_rl.tools.driving.viewer.view import View

_CONTROLS, _PLOTS, _GAP = 264.0, 304.0, 12.0  # pixels: two windows' widths, and around them
_HEIGHT, _PLOT_HEIGHT = 740.0, 172.0
_AXIS_KEYS = {FORWARD: "W S", LEFT: "Q E", YAW: "A D"}
_UNITS = {FORWARD: "m/s", LEFT: "m/s", YAW: "rad/s"}
_TRACKING = int(mujoco.mjtCamera.mjCAMERA_TRACKING)
_FREE = int(mujoco.mjtCamera.mjCAMERA_FREE)
_BASE_BODY = 1  # the robot's comes first, the ghost's follow


class Panel(plugin.ViewerPlugin):
    """Draws the controls; the keys are heard elsewhere, at once, and not once a picture.

    It runs in the page's thread: it reads the cockpit and posts to it.
    """

    def __init__(self, cockpit: Cockpit, view: View) -> None:
        """Keep both; they are read in every frame."""
        self.cockpit, self.view = cockpit, view
        self._robot = ""

    @messages.handler
    def on_start(self, event: plugin.ViewerInitEvent) -> None:
        """Set the look."""
        ux.setup_theme(ux.GuiTheme.DARK)

    @messages.handler
    def on_model(self, event: messages.PostModelEvent) -> None:
        """Point the camera at the robot; on another ground it stays as it was turned."""
        camera, driver = self.viewer.camera, self.cockpit.driver
        if driver.robot.name == self._robot:
            return
        self._robot = driver.robot.name
        tallest = max(p.base_height for p in driver.metadata.keyframes.values())
        mujoco.mjv_defaultFreeCamera(self.viewer.model, camera)
        camera.azimuth, camera.elevation, camera.distance = 130, -16, 5.5 * tallest
        camera.trackbodyid = _BASE_BODY

    @messages.handler
    def on_frame(self, event: messages.BuildGuiEvent) -> None:
        """Draw everything once."""
        self._aim()
        self.view.typing = imgui.GetIO().WantCaptureKeyboard
        size = imgui.GetIO().DisplaySize
        with widgets.look():
            most = min(size.y - 2 * _GAP, _HEIGHT)
            widgets.window("drive", (_GAP, _GAP), (_CONTROLS, most), self._controls)
            corner = (size.x - _PLOTS - _GAP, _GAP)
            widgets.window("plots", corner, (_PLOTS, most), self._plots)

    def _aim(self) -> None:
        """Let the camera follow or not, and show the ghost or not."""
        follow, viewer = self.view.follow, self.viewer
        viewer.camera.type = _TRACKING if follow else _FREE
        viewer.camera_index = ux.TRACKING_CAMERA_IDX if follow else ux.TUMBLE_CAMERA_IDX
        viewer.vis_options.geomgroup[GHOST_GROUP] = int(self.view.ghost != "off")

    # --- left: controls --------------------------------------------------------------------------

    def _controls(self) -> None:
        widgets.selectors(self.view.selectors)
        widgets.heading("Skill")
        for index, name in enumerate(self.cockpit.skills):
            chosen = index == self.cockpit.skill
            if widgets.button(name.replace("_", " "), str(index + 1), chosen):
                self.cockpit.post(self.cockpit.choose_skill, index)
        widgets.heading("Velocity")
        for axis in (FORWARD, LEFT, YAW):
            self._slider(axis)
        self._row(("Stop", "Space"))
        widgets.heading("Robot")
        self._row(("Push", "P"), ("Reset", "R"))
        self._push_slider()
        widgets.heading("Time")
        self._row(("Go on" if self.cockpit.paused else "Pause", "T"), ("One step", "N"))
        self._row((f"Speed {self.cockpit.speed:g} x", "M"), chosen=self.cockpit.speed < SPEEDS[0])
        widgets.heading("View")
        self._view_row()
        self._status()

    def _row(self, *buttons: tuple[str, str], chosen: bool = False) -> None:
        """Draw buttons side by side; each does what its key does."""
        for index, (label, key) in enumerate(buttons):
            if index:
                imgui.SameLine()
            pausing = key == "T" and self.cockpit.paused
            if widgets.button(label, key, chosen or pausing, share=len(buttons)):
                bindings.press(self.cockpit, key)

    def _slider(self, axis: int) -> None:
        low, high = self.cockpit.limits[axis]
        if low == high:
            return  # the policy was not trained to move that way
        value = self.cockpit.target[axis]
        text = f"{AXES[axis]}  {value:+.2f} {_UNITS[axis]}"
        changed, value = widgets.slider(text, AXES[axis], value, (low, high), _AXIS_KEYS[axis])
        if changed:
            self.cockpit.post(self.cockpit.set_target, axis, value)

    def _push_slider(self) -> None:
        speed = self.cockpit.push_speed
        changed, value = widgets.slider(f"by {speed:.1f} m/s", "push", speed, (0.1, 1.5))
        if changed:
            self.cockpit.push_speed = value

    def _view_row(self) -> None:
        if widgets.button(f"Ghost {self.view.ghost}", "G", False, share=2):
            self.view.next_ghost()
        imgui.SameLine()
        if widgets.button("Follow", "C", self.view.follow, share=2):
            self.view.follow = not self.view.follow

    def _status(self) -> None:
        cockpit = self.cockpit
        imgui.Spacing()
        crossings = "" if cockpit.tile.is_flat else f"    crossed {cockpit.crossings}"
        widgets.faint(f"real time {self.view.real_time:.2f} x    falls {cockpit.falls}{crossings}")
        slow = "pictures are slow here: fewer details" if self.view.detail.is_reduced else ""
        for text in (slow, self.view.gamepad, cockpit.notice):
            if text:
                widgets.faint(text)

    # --- right: plots ----------------------------------------------------------------------------

    def _plots(self) -> None:
        telemetry = self.cockpit.telemetry
        kept = telemetry.view()
        for title, levels, lines in _figures(kept):
            size = (_PLOTS - 24, _PLOT_HEIGHT)
            draw_plot(title, kept["time"], lines, levels, size, telemetry.seconds)


def _figures(
    kept: dict[str, np.ndarray],
) -> list[tuple[str, tuple[float, ...], list[Line]]]:
    """Return title, marked levels and lines of every plot."""
    degrees = np.rad2deg

    def lines(measured: np.ndarray, target: np.ndarray) -> list[Line]:
        return [Line("is", MEASURED, measured), Line("target", TARGET, target)]

    forward = lines(kept["lin_vel_x"], kept["command_x"])
    return [
        (
            "Base height, cm",
            (10.0, 20.0, 30.0),
            lines(100 * kept["base_height"], 100 * kept["target_height"]),
        ),
        (
            "Pitch, degrees, nose down +",
            (-20.0, 0.0, 20.0),
            lines(degrees(kept["pitch"]), degrees(kept["target_pitch"])),
        ),
        (
            "Forward velocity, m/s",
            (0.0, 0.2, 0.4),
            [*forward, Line("estimate", ESTIMATE, kept["estimate_x"])],
        ),
        ("Yaw rate, rad/s", (-0.5, 0.0, 0.5), lines(kept["yaw_rate"], kept["command_yaw"])),
    ]
