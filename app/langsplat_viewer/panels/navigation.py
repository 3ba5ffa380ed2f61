"""Mouse and keys: pressed keys run commands, held keys and drags move the camera."""

from collections import deque
from dataclasses import dataclass
from typing import Any

from imgui_bundle import glfw_utils  # noqa: F401  isort: skip  (before glfw: it brings a library of its own)
import glfw  # isort: skip
import math
from functools import cache

from imgui_bundle import imgui

from langsplat_viewer.actions import settings, viewpoint
from langsplat_viewer.camera import controls
from langsplat_viewer.commands import COMMANDS, Command
from langsplat_viewer.panels import select, ui
from langsplat_viewer.state import ViewerState
from langsplat_viewer.viewer import Viewer

# Keys in the order in which they were pressed, however slow the frames are, each with the modifiers and the
# keyboard focus of its own moment. imgui takes all keys that arrived between two frames as one chord: after
# Ctrl + F the first letters of a phrase would be shortcuts. Here they wait: one press a frame, and none while
# a text box is about to take the keyboard.

RENAMED = {  # glfw's names, of which imgui has others
    **{name: f"{name}_arrow" for name in ("left", "right", "up", "down")},
    **{f"{side}_control": f"{side}_ctrl" for side in ("left", "right")},
}
MODIFIERS = (  # imgui's modifiers, and the keys that are one of them
    (imgui.Key.mod_ctrl, (glfw.KEY_LEFT_CONTROL, glfw.KEY_RIGHT_CONTROL)),
    (imgui.Key.mod_shift, (glfw.KEY_LEFT_SHIFT, glfw.KEY_RIGHT_SHIFT)),
    (imgui.Key.mod_alt, (glfw.KEY_LEFT_ALT, glfw.KEY_RIGHT_ALT)),
    (imgui.Key.mod_super, (glfw.KEY_LEFT_SUPER, glfw.KEY_RIGHT_SUPER)),
)
FOCUS_FRAMES = 3, 8  # least and most that a box has to take the keyboard; the one before may still have it


def _keys() -> dict[int, imgui.Key]:
    """Return GLFW's keys as imgui's; those that imgui does not know are left out."""
    found = {}
    for name in dir(glfw):
        if name.startswith("KEY_"):
            plain = name[4:].lower()
            plain = plain.replace("kp_", "keypad") if plain[3:].isdigit() else plain.replace("kp_", "keypad_")
            known = getattr(imgui.Key, f"_{plain}" if plain.isdigit() else RENAMED.get(plain, plain), None)
            if isinstance(known, imgui.Key):
                found[getattr(glfw, name)] = known
    return found


KEYS = _keys()


@dataclass(frozen=True)
class Event:
    """A key that went down or up, with the modifiers held then; or a character."""

    key: imgui.Key | None = None
    down: bool = False
    held: tuple[bool, ...] = ()  # of MODIFIERS
    character: int = 0


class Keyboard:
    """Takes the keys of one window from GLFW and gives them to imgui."""

    def __init__(self, state: ViewerState) -> None:
        self._state = state
        self._events: deque[Event] = deque()
        self._waited = 0  # frames, for a box
        self.given = 0  # events that imgui has got

    @property
    def is_waiting(self) -> bool:
        """True while some events are left for the next frames."""
        return bool(self._events)

    def listen(self, window: Any) -> None:
        """Take the place of imgui's own callbacks."""
        glfw.set_key_callback(window, self.pressed)
        glfw.set_char_callback(window, self.typed)

    def pressed(self, window: Any, key: int, scancode: int, action: int, mods: int) -> None:
        """Take a key that went down or up; GLFW's repeats are left to imgui."""
        if action not in (glfw.PRESS, glfw.RELEASE):
            return
        held = tuple(any(glfw.get_key(window, one) == glfw.PRESS for one in keys) for _, keys in MODIFIERS)
        self.add(Event(_as_printed(key, scancode), action == glfw.PRESS, held))

    def typed(self, window: Any, character: int) -> None:
        """Take a character."""
        self.add(Event(character=character))

    def add(self, event: Event) -> None:
        """Queue an event."""
        self._events.append(event)

    def feed(self) -> None:
        """Give imgui the events that belong to the next frame; before it begins."""
        io = imgui.get_io()
        least, most = FOCUS_FRAMES
        if self._state.awaits_keyboard and self._waited < (least if io.want_text_input else most):
            self._waited += 1
            return
        self._state.awaits_keyboard, self._waited = False, 0
        if len(imgui.get_current_context().input_events_queue) > 0:
            return  # what imgui itself has put off comes first
        typing, has_text, is_pressed = io.want_text_input, False, False
        while self._events:
            event = self._events[0]
            is_text = bool(event.character) or (typing and event.down and _is_letter(event))
            starts = event.down and not is_text
            # a frame takes a run of text, or one key, whose modifiers stay down until it ends
            if (is_pressed and (typing or not is_text)) or (starts and typing and has_text):
                return
            self._events.popleft()
            self.given += 1
            is_pressed, has_text = is_pressed or starts, has_text or is_text
            if event.character or not is_text:  # the box reads characters: their keys would take a frame each
                _give(io, event)


def _as_printed(key: int, scancode: int) -> imgui.Key | None:
    """Return a key by the letter or digit printed on it, where it has one: Ctrl + Z is Z on every layout."""
    name = "" if glfw.KEY_KP_0 <= key <= glfw.KEY_KP_EQUAL else glfw.get_key_name(key, scancode) or ""
    name = name.decode() if isinstance(name, bytes) else name
    if len(name) == 1 and name.isascii() and name.isalnum():
        return imgui.Key[f"_{name}" if name.isdigit() else name.lower()]
    return KEYS.get(key)


def _is_letter(event: Event) -> bool:
    """Return whether a key makes a character: it is none that imgui would have to keep apart from them."""
    return (
        event.key is not None
        and not any(event.held[index] for index in (0, 2, 3))
        and (imgui.Key["_0"] <= event.key <= imgui.Key.z or event.key == imgui.Key.space)
    )


def _give(io: imgui.IO, event: Event) -> None:
    if event.character:
        io.add_input_character(event.character)
        return
    for (modifier, _), is_held in zip(MODIFIERS, event.held, strict=True):
        io.add_key_event(modifier, is_held)
    if event.key is not None:
        io.add_key_event(event.key, event.down)


# Pressed keys run commands.

NAMED = {  # keys whose name in imgui is another
    "Esc": "escape",
    "PageUp": "page_up",
    "PageDown": "page_down",
    **{name: f"{name.lower()}_arrow" for name in ("Left", "Right", "Up", "Down")},
}
WHILE_TYPING = ("F1", "Esc")  # beside those with Ctrl


@dataclass(frozen=True)
class Chord:
    """A key with what must be held with it, or a typed character."""

    key: imgui.Key | None = None
    character: str = ""
    ctrl: bool = False  # on a Mac the command key, as imgui has it
    shift: bool = False
    alt: bool = False
    is_plain: bool = True  # not while something is typed


@cache
def chord(text: str) -> Chord:
    """Parse a key such as "Ctrl+Shift+P", "F1", "R", "7" or "?". KeyError for an unknown key."""
    *held, name = text.split("+")
    if not name.isalnum():
        return Chord(character=name)
    key = imgui.Key[f"_{name}" if name.isdigit() else NAMED.get(name, name.lower())]
    ctrl, shift, alt = (name in held for name in ("Ctrl", "Shift", "Alt"))
    return Chord(key, "", ctrl, shift, alt, is_plain=not ctrl and name not in WHILE_TYPING)


def handle_keys(viewer: Viewer) -> None:
    """Run the commands whose keys were pressed in this frame."""
    typing = imgui.get_io().want_text_input
    if imgui.is_mouse_clicked(imgui.MouseButton_.left):
        settings.put(viewer.state, letters_muted=False)
    for command in COMMANDS:
        if any(_pressed(chord(text), command, typing, viewer.state.letters_muted) for text in command.keys):
            command.act(viewer)
            return


def _pressed(wanted: Chord, command: Command, typing: bool, muted: bool) -> bool:
    io = imgui.get_io()
    if (typing and (wanted.is_plain or command.is_edit)) or (muted and wanted.is_plain):
        return False
    if wanted.key is None:
        return not io.key_ctrl and wanted.character in map(chr, io.input_queue_characters)
    held = (io.key_ctrl, io.key_shift, io.key_alt)
    if io.key_super or held != (wanted.ctrl, wanted.shift, wanted.alt):
        return False
    return imgui.is_key_pressed(wanted.key, command.repeats)


# Mouse and held keys over the scene.

ROLL_SPEED = 1.0  # radians per second
LONGEST_FRAME = 0.1  # seconds; a stalled frame must not throw a flying camera across the scene
WHEEL_STEP = 0.88  # factor of the distance per notch


def handle(viewer: Viewer, area: ui.Area) -> None:
    """Handle mouse and keys; once per frame, after the panels have taken what is theirs."""
    io = imgui.get_io()
    held = select.holds_mouse(viewer)
    if not held:
        select.handle_stroke(viewer, area)
    if viewer.state.view is not None and not io.want_capture_mouse and not held:
        _mouse(viewer, area)
    viewpoint.hover(viewer, _pixel(area))
    handle_keys(viewer)
    letters = not (io.want_text_input or io.key_ctrl or viewer.state.letters_muted)
    if viewer.state.view is not None and letters:
        _fly(viewer)


def _pixel(area: ui.Area) -> tuple[int, int] | None:
    """Return the mouse's place in the scene's area, pixels; None where a panel has it or a button is held."""
    io = imgui.get_io()
    if io.want_capture_mouse or any(imgui.is_mouse_down(button) for button in range(3)):
        return None
    scale = io.display_framebuffer_scale
    x, y = (io.mouse_pos.x - area.left) * scale.x, (io.mouse_pos.y - area.top) * scale.y
    return math.floor(x), math.floor(y)


def _mouse(viewer: Viewer, area: ui.Area) -> None:
    """Turn by the left button; while a tool has it, by the middle one."""
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


def _fly(viewer: Viewer) -> None:
    """Keys that act as long as they are held."""
    io, extent, key = imgui.get_io(), viewer.state.extent, imgui.Key
    assert extent is not None

    def held(plus: imgui.Key, minus: imgui.Key) -> int:
        return int(imgui.is_key_down(plus)) - int(imgui.is_key_down(minus))

    seconds = min(io.delta_time, LONGEST_FRAME)
    right, up, ahead = held(key.d, key.a), held(key.e, key.q), held(key.w, key.s)
    if right or up or ahead:
        factor = 4.0 if io.key_shift else 0.25 if io.key_alt else 1.0
        step = factor * viewer.state.preferences.fly_speed * extent.radius * seconds
        viewpoint.move(viewer, lambda view: controls.fly(view, right * step, up * step, ahead * step))
    turn = held(key.right_bracket, key.left_bracket)
    if turn:
        viewpoint.move(viewer, lambda view: controls.roll(view, turn * ROLL_SPEED * seconds))
