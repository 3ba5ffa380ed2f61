"""Mouse and keys over the scene -> camera moves and actions."""

import math
from collections.abc import Callable
from pathlib import Path

from imgui_bundle import imgui

from langsplat_viewer import actions, controls, saving
from langsplat_viewer.panels.layout import Area
from langsplat_viewer.panels.view import BUTTONS
from langsplat_viewer.viewer import Viewer

NEAREST = 0.02  # of the scene's radius: the closest the camera comes to its centre of turning
ROLL_SPEED = 1.0  # radians per second
LONGEST_FRAME = 0.1  # seconds; a stalled frame must not throw a flying camera across the scene
# (key, whether holding it repeats it, what it does); `help.KEYS` tells people
SHORTCUTS: tuple[tuple[imgui.Key, bool, Callable[[Viewer], object]], ...] = (
    (imgui.Key.r, False, actions.reset_view),
    (imgui.Key.f, False, actions.focus_result),
    (imgui.Key.comma, True, lambda viewer: actions.step_camera(viewer, -1)),
    (imgui.Key.period, True, lambda viewer: actions.step_camera(viewer, 1)),
    (imgui.Key.p, False, lambda viewer: saving.save_picture(viewer, Path.cwd())),
    (imgui.Key.slash, False, actions.focus_search),
    (imgui.Key.tab, False, actions.toggle_panel),
    (imgui.Key.f1, False, actions.toggle_help),
    (imgui.Key.escape, False, lambda viewer: actions.show_help(viewer, False)),
)


def handle(viewer: Viewer, area: Area) -> None:
    """Once per frame, after the panels: they take what is theirs first."""
    io = imgui.get_io()
    if viewer.state.view is not None and not io.want_capture_mouse:
        _mouse(viewer, area)
    if not io.want_text_input:
        _keys(viewer)
        if viewer.state.view is not None and not io.key_ctrl:
            _fly(viewer)


def _mouse(viewer: Viewer, area: Area) -> None:
    io, extent = imgui.get_io(), viewer.state.extent
    assert extent is not None
    if imgui.is_mouse_double_clicked(0):
        actions.focus_pixel(viewer, *area.fraction(io.mouse_pos.x, io.mouse_pos.y))
        return
    dx, dy = io.mouse_delta.x, io.mouse_delta.y
    if dx or dy:
        turn = math.pi / area.height  # a drag over the whole height is half a turn
        if _held(1) or _held(2) or (_held(0) and io.key_shift):
            size = (max(round(area.width), 1), max(round(area.height), 1))
            actions.move(viewer, lambda view: controls.pan(view, dx, dy, size))
        elif _held(0) and io.key_ctrl:
            actions.move(viewer, lambda view: controls.look(view, dx * turn, dy * turn))
        elif _held(0):
            actions.move(viewer, lambda view: controls.orbit(view, dx * turn, dy * turn))
    if io.mouse_wheel:
        factor = 0.88**io.mouse_wheel
        actions.move(viewer, lambda view: controls.zoom(view, factor, NEAREST * extent.radius))


def _held(button: int) -> bool:
    """Whether a button drags. Where frames are slow, the way to the place of the click and the click itself
    fall into one frame; that way was no drag."""
    return imgui.is_mouse_down(button) and not imgui.is_mouse_clicked(button)


def _keys(viewer: Viewer) -> None:
    for key, repeats, act in SHORTCUTS:
        if imgui.is_key_pressed(key, repeats):
            act(viewer)
    for digit, button in enumerate(BUTTONS, start=1):
        if imgui.is_key_pressed(imgui.Key[f"_{digit}"], False):
            actions.set_display(viewer, button.display, button.latent_level)


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
        actions.move(viewer, lambda view: controls.fly(view, right * step, up * step, ahead * step))
    turn = held(key.right_bracket, key.left_bracket)
    if turn:
        actions.move(viewer, lambda view: controls.roll(view, turn * ROLL_SPEED * seconds))
