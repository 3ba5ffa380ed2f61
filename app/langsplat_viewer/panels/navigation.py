"""Mouse and keys: pressed keys run commands, held keys and drags move the camera."""

import math
from dataclasses import dataclass
from functools import cache

from imgui_bundle import imgui

from langsplat_viewer.actions import settings, viewpoint
from langsplat_viewer.camera import controls
from langsplat_viewer.commands import COMMANDS, Command
from langsplat_viewer.panels import select, ui
from langsplat_viewer.state import ViewerState
from langsplat_viewer.viewer import Viewer

# imgui gives each frame one press of a key, but of several keys that overlap. What follows a command of one
# letter, and what is typed before a text box has the keyboard, waits: after Ctrl + F the first letters of a
# phrase would be commands, and its Enter would be lost.

FOCUS_FRAMES = 3, 8  # least and most that a box has to take the keyboard; the one before may still have it
KEY, TEXT = imgui.internal.InputEventType.key, imgui.internal.InputEventType.text


class Keyboard:
    """Keeps keys for later frames, in their order."""

    def __init__(self, state: ViewerState) -> None:
        self._state = state
        self._kept = imgui.ImVector_InputEvent()
        self._waited = 0  # frames
        self._tabbed = self._is_lost = False  # in the last frame: Tab was pressed, nothing had the focus
        self._before: str | None = None  # the window that had it before one that passes, None for the view
        self._was_framed = False  # its widget with the keyboard

    @property
    def is_waiting(self) -> bool:
        """True while keys are left for the next frames."""
        return self._state.awaits_keyboard or len(imgui.get_current_context().input_events_queue) > 0

    def feed(self) -> None:
        """Give imgui the keys that belong to the next frame; before it begins."""
        queue, typing = imgui.get_current_context().input_events_queue, imgui.get_io().want_text_input
        any_popup = imgui.PopupFlags_.any_popup_id | imgui.PopupFlags_.any_popup_level
        self._state.has_escape = typing or imgui.is_popup_open("", any_popup)
        self._is_lost = not imgui.get_current_context().nav_id_is_alive
        waits = self._state.awaits_keyboard and self._waited < FOCUS_FRAMES[not typing]
        self._state.awaits_keyboard, self._waited = waits, self._waited + 1 if waits else 0
        keeps, now, has_text = waits or self._tabbed, imgui.ImVector_InputEvent(), False
        for event in sorted(queue, key=lambda event: event.event_id):
            keeps |= has_text and event.type == KEY  # not what a held key repeats: that would pile up
            (self._kept if keeps and event.type in (KEY, TEXT) else now).push_back(event)
            has_text |= event.type == TEXT and not typing
        queue.clear()
        for event in now:
            queue.push_back(event)

    def keep(self) -> None:
        """Queue the other keys once the frame has begun: imgui drops what repeats the last of its queue."""
        for event in self._kept:
            imgui.get_current_context().input_events_queue.push_back(event)
        self._kept.clear()
        self._return()
        self._tabbed, window = imgui.is_key_pressed(imgui.Key.tab), imgui.get_current_context().nav_window
        if self._tabbed and self._is_lost and window is not None:
            imgui.internal.nav_init_window(window, True)  # else Tab would lead nowhere
            imgui.set_nav_cursor_visible(True)

    def _return(self) -> None:
        """Give the keyboard back once palette or help is closed; imgui would give it to any window."""
        context, state = imgui.get_current_context(), self._state
        window = context.nav_window
        if window is None or window.root_window.name not in ("Commands", "Help"):
            self._before = None if window is None else window.name
            self._was_framed = context.nav_cursor_visible
        elif not (state.show_palette or state.show_help):
            imgui.set_window_focus(self._before)
            imgui.set_nav_cursor_visible(self._was_framed)


# Pressed keys run commands.

NAMED = {  # keys whose name in imgui is another
    "Esc": "escape",
    "PageUp": "page_up",
    "PageDown": "page_down",
}
MODIFIERS = {name: imgui.Key[f"mod_{name.lower()}"] for name in ("Ctrl", "Shift", "Alt")}
WHILE_TYPING = ("F1", "Esc")  # beside those with Ctrl


@dataclass(frozen=True)
class Chord:
    """A key with what must be held with it, or a typed character."""

    key: imgui.Key | None = None
    character: str = ""
    held: int = 0  # the bits of imgui's modifiers; Ctrl is on a Mac the command key
    is_plain: bool = True  # not while something is typed


@cache
def chord(text: str) -> Chord:
    """Parse a key such as "Ctrl+Shift+P", "F1", "R", "7" or "?". KeyError for an unknown key."""
    *held, name = text.split("+")
    if not name.isalnum():
        return Chord(character=name)
    key = imgui.Key[f"_{name}" if name.isdigit() else NAMED.get(name, name.lower())]
    bits = sum(int(MODIFIERS[name]) for name in held)
    return Chord(key, "", bits, is_plain="Ctrl" not in held and name not in WHILE_TYPING)


def handle_keys(viewer: Viewer) -> None:
    """Run the commands whose keys were pressed in this frame."""
    if imgui.is_mouse_clicked(imgui.MouseButton_.left):
        settings.put(viewer.state, letters_muted=False)
    typing, muted = imgui.get_io().want_text_input, viewer.state.letters_muted
    pressed = [one for one in COMMANDS if any(_pressed(chord(key), one, typing, muted) for key in one.keys)]
    for command in pressed:
        if not viewer.state.awaits_keyboard:  # by one of them, either
            command.act(viewer)


def _pressed(wanted: Chord, command: Command, typing: bool, muted: bool) -> bool:
    io = imgui.get_io()
    if (typing and (wanted.is_plain or command.is_edit)) or (muted and wanted.is_plain):
        return False
    if wanted.key is None:
        return not io.key_ctrl and wanted.character in map(chr, io.input_queue_characters)
    return int(io.key_mods) == wanted.held and imgui.is_key_pressed(wanted.key, command.repeats)


# Mouse and held keys over the scene.

TURN_SPEED = 1.0  # radians per second, of keys
LONGEST_FRAME = 0.1  # seconds; a stalled frame must not throw a flying camera across the scene
WHEEL_STEP = 0.88  # factor of the distance per notch


def handle(viewer: Viewer, area: ui.Area) -> None:
    """Handle mouse and keys; once per frame, after the panels have taken what is theirs."""
    io = imgui.get_io()
    held = select.holds_mouse(viewer)
    if not held:
        select.handle_stroke(viewer, area)
    if viewer.state.open is not None and not io.want_capture_mouse and not held:
        _mouse(viewer, area)
    viewpoint.hover(viewer, _pixel(area))
    handle_keys(viewer)
    letters = not (io.want_text_input or io.key_ctrl or viewer.state.letters_muted)
    if viewer.state.open is not None and letters:
        _fly(viewer, viewer.state.open.extent.radius)


def _pixel(area: ui.Area) -> tuple[int, int] | None:
    """Return the mouse's pixel in the scene's area; None where a panel has it or a button is held."""
    io = imgui.get_io()
    if io.want_capture_mouse or any(imgui.is_mouse_down(button) for button in range(3)):
        return None
    scale = io.display_framebuffer_scale
    x, y = (io.mouse_pos.x - area.left) * scale.x, (io.mouse_pos.y - area.top) * scale.y
    return math.floor(x), math.floor(y)


def _mouse(viewer: Viewer, area: ui.Area) -> None:
    """Move the camera by the mouse: the left button turns it or, while a tool has that, the middle one."""
    io = imgui.get_io()
    free = viewer.state.tools.tool is None
    turns = 0 if free else 2
    if free and imgui.is_mouse_double_clicked(0) and not viewer.state.session.ruler.measures:
        viewpoint.focus_pixel(viewer, *area.fraction(io.mouse_pos.x, io.mouse_pos.y))
        return
    dx, dy = io.mouse_delta.x, io.mouse_delta.y
    if dx or dy:
        turn = math.pi / area.height  # a drag over the whole height is half a turn
        if _held(1) or (free and (_held(2) or (_held(0) and io.key_shift))):
            viewpoint.move(viewer, lambda view: controls.pan(view, dx, dy, area.size))
        elif _held(turns) and io.key_ctrl:
            viewpoint.move(viewer, lambda view: controls.look(view, dx * turn, dy * turn))
        elif _held(turns):
            viewpoint.move(viewer, lambda view: controls.orbit(view, dx * turn, dy * turn))
    if io.mouse_wheel:
        viewpoint.zoom_by(viewer, WHEEL_STEP**io.mouse_wheel)


def _held(button: int) -> bool:
    """Return whether a button drags.

    Where frames are slow, the way to the place of the click and the click itself fall into one frame; that
    way was no drag.
    """
    return imgui.is_mouse_down(button) and not imgui.is_mouse_clicked(button)


def _fly(viewer: Viewer, radius: float) -> None:
    """Move the camera by the keys that act as long as they are held; `radius`: the scene's."""
    io, key = imgui.get_io(), imgui.Key

    def held(plus: imgui.Key, minus: imgui.Key) -> int:
        return int(imgui.is_key_down(plus)) - int(imgui.is_key_down(minus))

    seconds = min(io.delta_time, LONGEST_FRAME)
    right, up, ahead = held(key.d, key.a), held(key.e, key.q), held(key.w, key.s)
    if right or up or ahead:
        factor = 4.0 if io.key_shift else 0.25 if io.key_alt else 1.0
        step = factor * viewer.state.preferences.fly_speed * radius * seconds
        viewpoint.move(viewer, lambda view: controls.fly(view, right * step, up * step, ahead * step))
    turn = TURN_SPEED * seconds
    if roll := held(key.right_bracket, key.left_bracket):
        viewpoint.move(viewer, lambda view: controls.roll(view, roll * turn))
    yaw, pitch = held(key.keypad6, key.keypad4), held(key.keypad2, key.keypad8)
    if yaw or pitch:
        viewpoint.move(viewer, lambda view: controls.orbit(view, yaw * turn, pitch * turn))
    if nearer := held(key.keypad_add, key.keypad_subtract):
        viewpoint.zoom_by(viewer, WHEEL_STEP ** (10 * nearer * turn))
