"""From the keys as `commands` writes them to those that are pressed."""

from dataclasses import dataclass
from functools import cache

from imgui_bundle import imgui

from langsplat_viewer import actions
from langsplat_viewer.commands import COMMANDS, Command
from langsplat_viewer.viewer import Viewer

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
    """What is meant by "Ctrl+Shift+P", "F1", "R", "7" or "?". KeyError for an unknown key."""
    *held, name = text.split("+")
    if not name.isalnum():
        return Chord(character=name)
    key = _key(name)
    ctrl, shift, alt = (name in held for name in ("Ctrl", "Shift", "Alt"))
    return Chord(key, "", ctrl, shift, alt, is_plain=not ctrl and name not in WHILE_TYPING)


def _key(name: str) -> imgui.Key:
    return imgui.Key[f"_{name}" if name.isdigit() else NAMED.get(name, name.lower())]


def handle(viewer: Viewer) -> None:
    """Run the commands whose keys were pressed in this frame."""
    state, typing = viewer.state, imgui.get_io().want_text_input
    for command in COMMANDS:
        if any(_pressed(chord(text), command, typing, state.letters_muted) for text in command.keys):
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


def muted_until_clicked(viewer: Viewer) -> None:
    """Letters are keys again once something is clicked; to be called before the panels are drawn."""
    if imgui.is_mouse_clicked(imgui.MouseButton_.left):
        actions.mute_letters(viewer, False)
