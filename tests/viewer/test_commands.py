"""The table of commands: keys, help and palette are made from it."""

from collections import Counter

import pytest

from langsplat_viewer.actions import settings, viewpoint
from langsplat_viewer.commands import BUTTONS, COMMANDS, MENUS, PANEL_TITLES, in_menu, matching
from langsplat_viewer.panels.layout import PANELS, key_rows
from langsplat_viewer.panels.navigation import chord

KEYS = {key: command for command in COMMANDS for key in command.keys}


def test_no_key_does_two_things():
    assert [key for key, count in Counter(k for c in COMMANDS for k in c.keys).items() if count > 1] == []


@pytest.mark.parametrize(
    ("key", "does"),
    [
        ("Ctrl+O", "open a scene"),
        ("Ctrl+S", "save a picture"),
        ("Ctrl+F", "search"),
        ("Ctrl+Z", "undo"),
        ("Ctrl+Shift+P", "find a command"),
        ("R", "return to the opening view"),
        ("Ctrl+A", "select everything"),
        ("Ctrl+D", "select nothing"),
        ("Ctrl+Shift+A", "select nothing"),
        ("Ctrl+I", "invert the selection"),
        ("H", "hide the selection"),
        ("Shift+H", "isolate the selection"),
        ("U", "show all that is hidden"),
        ("Alt+H", "show all that is hidden"),
        ("Delete", "delete the selection"),
        ("Home", "return to the opening view"),
        ("F1", "list of keys"),
        ("?", "list of keys"),
        ("Esc", "close what lies over the scene"),
    ],
)
def test_keys_are_what_they_are_everywhere(key, does):
    assert KEYS[key].does == does


def test_every_key_is_understood_and_letters_are_plain():
    for key in KEYS:
        understood = chord(key)
        assert (understood.key is None) == bool(understood.character)
        assert understood.is_plain == (not key.startswith("Ctrl") and key not in ("F1", "Esc")), key
    assert chord("Ctrl+Shift+P").ctrl
    assert chord("Ctrl+Shift+P").shift
    assert (chord("Alt+H").alt, chord("H").alt) == (True, False)
    assert chord("Shift+F").is_plain  # a capital letter is typed


def test_every_menu_has_commands_and_every_menu_named_is_there():
    assert all(in_menu(menu) for menu in MENUS)
    assert {command.menu for command in COMMANDS} - {""} == set(MENUS)


def test_every_panel_can_be_opened_by_a_command(viewer):
    assert tuple(panel.title for panel in PANELS) == PANEL_TITLES
    for title in PANEL_TITLES:
        (command,) = matching(f"panel: {title}")
        command.act(viewer)
        assert settings.take_wanted_panel(viewer) == title
    assert settings.take_wanted_panel(viewer) == ""


def test_help_lists_every_key():
    listed = " ".join(keys for keys, _ in key_rows())
    assert all(key in listed for key in KEYS)


def test_every_display_has_its_digit():
    assert [f"{n}" in KEYS for n in range(1, len(BUTTONS) + 1)] == [True] * len(BUTTONS)


def test_commands_are_found_by_their_words(opened):
    assert matching("") == list(COMMANDS)
    (found,) = matching("OPENING view")
    assert found.act is viewpoint.reset_view
    assert matching("make coffee") == []


def test_every_command_does_something_sensible_before_a_scene_is_open(viewer, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for command in COMMANDS:
        command.act(viewer)
    assert list(tmp_path.iterdir()) == []
