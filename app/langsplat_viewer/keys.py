"""Keys as people read them: "Ctrl+Shift+P", "F1", "R", or a typed character such as "?". No window here."""

import string
from collections.abc import Mapping
from dataclasses import dataclass

HELD_WITH = ("Ctrl", "Shift", "Alt")  # in this order
NAMED = (
    *string.ascii_uppercase,
    *string.digits,
    *(f"F{number}" for number in range(1, 13)),
    *("Tab", "Home", "End", "PageUp", "PageDown", "Insert", "Delete", "Backspace", "Space"),
    *("Left", "Right", "Up", "Down"),
    *(f"Keypad{number}" for number in range(10)),
)
FLYING = {key: f"{key} flies" for key in "WASDQE"} | {key: f"{key} rolls the camera" for key in "[]"}
TYPING = {
    "Ctrl+C": "copies in every box",
    "Ctrl+V": "pastes in every box",
    "Ctrl+X": "cuts in every box",
}

Changed = Mapping[str, tuple[str, ...]]  # by what a command does, its keys in place of those of the table


def is_symbol(character: str) -> bool:
    """Whether a typed character can be a key by itself."""
    return len(character) == 1 and character.isprintable() and not (character.isalnum() or character in " +")


def problem(text: str) -> str:
    """Why no command can have this key, one line; empty where one can."""
    *held, name = text.split("+")
    if name == "Esc":
        return "Esc closes what lies over the scene"
    if text in TYPING:
        return f"{text} {TYPING[text]}"
    if "Ctrl" not in held and name in FLYING:
        return FLYING[name]
    is_chord = name in NAMED and held == [key for key in HELD_WITH if key in held]
    return "" if is_chord or is_symbol(text) else f"{text[:20]!r} is no key"


@dataclass(frozen=True)
class Conflict:
    """A key that was wanted for one command and is another's."""

    wanted_by: str  # what the command does
    key: str
    owner: str


@dataclass(frozen=True)
class Keying:
    """Changing the keys, in the list of keys."""

    edits: bool = False
    waiting: str = ""  # the command that takes the key that is pressed next, by what it does
    conflict: Conflict | None = None
    typed: str = ""  # words of the commands that are listed
