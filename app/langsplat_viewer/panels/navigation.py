"""Mouse and held keys over the scene -> camera moves; pressed keys -> commands."""

import math

from imgui_bundle import imgui

from langsplat_viewer import actions
from langsplat_viewer.camera import controls
from langsplat_viewer.panels import keyboard, stroke
from langsplat_viewer.panels.area import Area
from langsplat_viewer.viewer import Viewer

ROLL_SPEED = 1.0  # radians per second
LONGEST_FRAME = 0.1  # seconds; a stalled frame must not throw a flying camera across the scene
WHEEL_STEP = 0.88  # factor of the distance per notch


def handle(viewer: Viewer, area: Area) -> None:
    """Once per frame, after the panels: they take what is theirs first."""
    io = imgui.get_io()
    stroke.handle(viewer, area)
    if viewer.state.view is not None and not io.want_capture_mouse:
        _mouse(viewer, area)
    actions.hover(viewer, _pixel(area))
    keyboard.handle(viewer)
    letters = not (io.want_text_input or io.key_ctrl or viewer.state.letters_muted)
    if viewer.state.view is not None and letters:
        _fly(viewer)


def _pixel(area: Area) -> tuple[int, int] | None:
    """Where the mouse is in the scene's area, pixels; None where a panel has it, or a button is held."""
    io = imgui.get_io()
    if io.want_capture_mouse or any(imgui.is_mouse_down(button) for button in range(3)):
        return None
    scale = io.display_framebuffer_scale
    x, y = (io.mouse_pos.x - area.left) * scale.x, (io.mouse_pos.y - area.top) * scale.y
    return math.floor(x), math.floor(y)


def _mouse(viewer: Viewer, area: Area) -> None:
    """The left button turns; while a tool has it, the middle one does."""
    io = imgui.get_io()
    free = viewer.state.selection.tool is None
    turns = 0 if free else 2
    if free and imgui.is_mouse_double_clicked(0):
        actions.focus_pixel(viewer, *area.fraction(io.mouse_pos.x, io.mouse_pos.y))
        return
    dx, dy = io.mouse_delta.x, io.mouse_delta.y
    if dx or dy:
        turn = math.pi / area.height  # a drag over the whole height is half a turn
        if _held(1) or (free and (_held(2) or (_held(0) and io.key_shift))):
            size = (max(round(area.width), 1), max(round(area.height), 1))
            actions.move(viewer, lambda view: controls.pan(view, dx, dy, size))
        elif _held(turns) and io.key_ctrl:
            actions.move(viewer, lambda view: controls.look(view, dx * turn, dy * turn))
        elif _held(turns):
            actions.move(viewer, lambda view: controls.orbit(view, dx * turn, dy * turn))
    if io.mouse_wheel:
        actions.zoom_by(viewer, WHEEL_STEP**io.mouse_wheel)


def _held(button: int) -> bool:
    """Whether a button drags. Where frames are slow, the way to the place of the click and the click itself
    fall into one frame; that way was no drag."""
    return imgui.is_mouse_down(button) and not imgui.is_mouse_clicked(button)


def _fly(viewer: Viewer) -> None:
    """Keys that act as long as they are held."""
    io, extent, key = imgui.get_io(), viewer.state.extent, imgui.Key
    assert extent is not None

    def held(plus: imgui.Key, minus: imgui.Key) -> int:
        return int(imgui.is_key_down(plus)) - int(imgui.is_key_down(minus))

    seconds = min(io.delta_time, LONGEST_FRAME)
    right, up, ahead = held(key.d, key.a), held(key.e, key.q), held(key.w, key.s)
    if right or up or ahead:
        pace = 4.0 if io.key_shift else 0.25 if io.key_alt else 1.0
        step = pace * viewer.state.fly_speed * extent.radius * seconds
        go = controls.walk if viewer.state.walks else controls.fly
        actions.move(viewer, lambda view: go(view, right * step, up * step, ahead * step))
    turn = held(key.right_bracket, key.left_bracket)
    if turn:
        actions.move(viewer, lambda view: controls.roll(view, turn * ROLL_SPEED * seconds))
