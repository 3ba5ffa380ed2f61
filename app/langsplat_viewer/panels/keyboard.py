"""Keys in the order in which they were pressed, however slow the frames are, each with the modifiers and the
keyboard focus of its own moment.

imgui takes all keys that arrived between two frames as one chord: after Ctrl + F the first letters of a
phrase would be shortcuts. Here they wait: one press a frame, and none while a text box is about to take the
keyboard.
"""

from collections import deque
from dataclasses import dataclass
from typing import Any

from imgui_bundle import glfw_utils  # noqa: F401  isort: skip  (before glfw: it brings a library of its own)
import glfw  # isort: skip
from imgui_bundle import imgui

from langsplat_viewer.state import ViewerState

RENAMED = {  # glfw's names, of which imgui has others
    **{name: f"{name}_arrow" for name in ("left", "right", "up", "down")},
    **{f"{side}_control": f"{side}_ctrl" for side in ("left", "right")},
}
HELD = (  # imgui's modifiers, and the keys that are one of them
    (imgui.Key.mod_ctrl, (glfw.KEY_LEFT_CONTROL, glfw.KEY_RIGHT_CONTROL)),
    (imgui.Key.mod_shift, (glfw.KEY_LEFT_SHIFT, glfw.KEY_RIGHT_SHIFT)),
    (imgui.Key.mod_alt, (glfw.KEY_LEFT_ALT, glfw.KEY_RIGHT_ALT)),
    (imgui.Key.mod_super, (glfw.KEY_LEFT_SUPER, glfw.KEY_RIGHT_SUPER)),
)
FOCUS_FRAMES = 3, 8  # least and most that a box has to take the keyboard; the one before may still have it


def _keys() -> dict[int, imgui.Key]:
    """glfw's keys as imgui's; those that imgui does not know are left out."""
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
    held: tuple[bool, ...] = ()  # of HELD
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
        held = tuple(any(glfw.get_key(window, one) == glfw.PRESS for one in keys) for _, keys in HELD)
        self.add(Event(_as_printed(key, scancode), action == glfw.PRESS, held))

    def typed(self, window: Any, character: int) -> None:
        """Take a character that was typed."""
        self.add(Event(character=character))

    def add(self, event: Event) -> None:
        """Append the latest event."""
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
    """The key by what is printed on it, where that is a letter or a digit: Ctrl + Z is Z on every layout."""
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
    for (modifier, _), is_held in zip(HELD, event.held, strict=True):
        io.add_key_event(modifier, is_held)
    if event.key is not None:
        io.add_key_event(event.key, event.down)
