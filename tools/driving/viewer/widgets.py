"""The few ImGui widgets that the panel is made of, in one look."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from mujoco.studio.dear_imgui import dear_imgui as imgui

from kiras_rl.tools.driving.viewer.view import Selector

_ACCENT = (0.93, 0.47, 0.13, 1.0)
_BRIGHT = (1.0, 1.0, 1.0, 1.0)
_FAINT = (0.66, 0.71, 0.77, 1.0)
_COLOURS = {
    imgui.Col.WindowBg: (0.09, 0.11, 0.14, 0.82),
    imgui.Col.Border: (1.0, 1.0, 1.0, 0.08),
    imgui.Col.Text: (0.95, 0.96, 0.98, 1.0),
    imgui.Col.Button: (0.22, 0.26, 0.31, 1.0),
    imgui.Col.ButtonHovered: (0.30, 0.35, 0.42, 1.0),
    imgui.Col.ButtonActive: _ACCENT,
    imgui.Col.FrameBg: (0.16, 0.19, 0.23, 1.0),
    imgui.Col.FrameBgHovered: (0.22, 0.26, 0.31, 1.0),
    imgui.Col.FrameBgActive: (0.22, 0.26, 0.31, 1.0),
    imgui.Col.SliderGrab: (0.45, 0.53, 0.62, 1.0),
    imgui.Col.SliderGrabActive: _ACCENT,
}
_WINDOW = (
    imgui.WindowFlags.NoTitleBar.value
    | imgui.WindowFlags.NoResize.value
    | imgui.WindowFlags.NoMove.value
    | imgui.WindowFlags.NoNav.value
    | imgui.WindowFlags.NoSavedSettings.value
    | imgui.WindowFlags.NoFocusOnAppearing.value
)
_PLAIN = imgui.ComboFlags.NoArrowButton.value  # where the arrow would be there is a key


@contextmanager
def look() -> Iterator[None]:
    """Draw what is inside in our colours and roundings."""
    for name, rgba in _COLOURS.items():
        imgui.PushStyleColor(int(name), imgui.Vec4(*rgba))
    variables = {
        imgui.StyleVar.WindowRounding: 8.0,
        imgui.StyleVar.FrameRounding: 5.0,
        imgui.StyleVar.GrabRounding: 4.0,
        imgui.StyleVar.WindowPadding: imgui.Vec2(12.0, 10.0),
        imgui.StyleVar.FramePadding: imgui.Vec2(8.0, 4.0),
        imgui.StyleVar.ItemSpacing: imgui.Vec2(6.0, 5.0),
        imgui.StyleVar.ButtonTextAlign: imgui.Vec2(0.0, 0.5),
    }
    for name, value in variables.items():
        imgui.PushStyleVar(int(name), value)
    yield
    imgui.PopStyleVar(len(variables))
    imgui.PopStyleColor(len(_COLOURS))


def window(
    name: str, corner: tuple[float, float], size: tuple[float, float], draw: Callable[[], None]
) -> None:
    """Draw a fixed window; it scrolls where it is too small."""
    imgui.SetNextWindowPos(imgui.Vec2(*corner))
    imgui.SetNextWindowSize(imgui.Vec2(*size))
    imgui.Begin(name, None, _WINDOW)
    draw()
    imgui.End()


def heading(text: str) -> None:
    """Write the name of a group of widgets."""
    imgui.Spacing()
    imgui.TextColored(imgui.Vec4(*_ACCENT), text)


def faint(text: str) -> None:
    """Write a line that is not meant to catch the eye."""
    imgui.PushStyleColor(int(imgui.Col.Text), imgui.Vec4(*_FAINT))
    imgui.TextWrapped(text)
    imgui.PopStyleColor(1)


def button(label: str, key: str, chosen: bool, share: int = 1) -> bool:
    """Draw a button with its key at its right end; return whether it was pressed.

    Args:
        label: What it does.
        key: The key that does the same.
        chosen: Whether it is lit.
        share: How many buttons have to fit into a row.
    """
    if chosen:
        imgui.PushStyleColor(int(imgui.Col.Button), imgui.Vec4(*_ACCENT))
    pressed = imgui.Button(f"{label}##{key}", imgui.Vec2(_width(share), 0))
    if chosen:
        imgui.PopStyleColor(1)
    _key_at_end(key, _BRIGHT if chosen else _FAINT)
    return pressed


def slider(
    text: str, name: str, value: float, limits: tuple[float, float], keys: str = ""
) -> tuple[bool, float]:
    """Draw a text, its keys and a slider below; return whether it was moved, and where to.

    Args:
        text: What it sets, and the value.
        name: Unique in its window.
        value: Where it stands.
        limits: Its ends.
        keys: The keys that do the same.
    """
    imgui.Text(text)
    width = imgui.GetWindowWidth() - 24.0
    imgui.SameLine(12.0 + width - 9.0 - imgui.CalcTextSize(keys).x)
    imgui.TextColored(imgui.Vec4(*_FAINT), keys)
    imgui.SetNextItemWidth(width)
    imgui.PushStyleVar(int(imgui.StyleVar.FramePadding), imgui.Vec2(8.0, -2.0))
    changed, value = imgui.SliderFloat(f"##{name}", float(value), *map(float, limits), "")
    imgui.PopStyleVar(1)
    return changed, value


def selectors(choices: Sequence[Selector]) -> None:
    """Draw lists to choose from; those that share a row follow one another."""
    filled = 1.0  # of the row
    for choice in choices:
        if choice.heading:
            heading(choice.heading)
            filled = 1.0
        part = 1 / choice.share
        if filled + part > 1 + 1e-9:
            filled = 0.0
        else:
            imgui.SameLine()
        filled += part
        _selector(choice)


def _selector(choice: Selector) -> None:
    imgui.SetNextItemWidth(_width(choice.share))
    current = choice.current()
    opened = imgui.BeginCombo(f"##{choice.label}", current, _PLAIN if choice.keys else 0)
    if not opened:
        if choice.keys:
            _key_at_end(choice.keys, _FAINT)
        return
    for index, option in enumerate(choice.options()):
        if imgui.Selectable(f"{option}##{index}", option == current):
            choice.choose(index)
    imgui.EndCombo()


def _width(share: int) -> float:
    """Return the width of a widget of which so many have to fit into a row."""
    gap = 6.0
    return (imgui.GetWindowWidth() - 24.0 - (share - 1) * gap) / share


def _key_at_end(key: str, rgba: tuple[float, float, float, float]) -> None:
    """Write a key into the right end of the widget that was just drawn."""
    low, high = imgui.GetItemRectMin(), imgui.GetItemRectMax()
    size = imgui.CalcTextSize(key)
    corner = imgui.Vec2(high.x - size.x - 9, 0.5 * (low.y + high.y - size.y))
    colour = imgui.ColorConvertFloat4ToU32(imgui.Vec4(*rgba))
    imgui.GetWindowDrawList().AddText(corner, colour, key)
