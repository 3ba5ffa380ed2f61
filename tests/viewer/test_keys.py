"""Keys that a user has changed, without a window."""

import json
from dataclasses import replace

import pytest

from langsplat_core.errors import InputError
from langsplat_viewer import actions, keying
from langsplat_viewer.commands import COMMANDS, keys_of, with_key
from langsplat_viewer.files.preferences import FILE_NAME, Preferences, load_preferences, save_preferences
from langsplat_viewer.keying import command_of
from langsplat_viewer.keys import NAMED, Keying, problem
from langsplat_viewer.panels.help import rows
from langsplat_viewer.panels.keyboard import chord
from tests.support.windowless import errors

RESET, FRAME, RELOAD = "return to the opening view", "frame everything", "reload the scene"


def keys(viewer, does: str) -> tuple[str, ...]:
    return keys_of(command_of(does), viewer.state.preferences.keys)


def press(viewer, does: str, key: str) -> None:
    keying.wait_for_key(viewer, command_of(does))
    assert viewer.state.keying.waiting == does
    keying.press(viewer, key)
    assert viewer.state.keying.waiting == ""


def test_every_key_of_the_table_could_be_given():
    for command in COMMANDS:
        for key in command.keys:
            assert (problem(key) == "") == keying.can_change(command), key


def test_every_key_that_can_be_given_is_understood():
    assert all(chord(name).key is not None for name in NAMED)
    assert chord("Ctrl+Shift+Left").shift
    assert chord("PageUp").is_plain


@pytest.mark.parametrize(
    ("key", "reason"),
    [
        ("Esc", "Esc closes"),
        ("W", "W flies"),
        ("Shift+D", "D flies"),
        ("[", "rolls"),
        ("Ctrl+C", "copies"),
        ("Shift+Ctrl+R", "no key"),
        ("Ctrl+?", "no key"),
        ("Meta", "no key"),
        ("+", "no key"),
        ("", "no key"),
        (" ", "no key"),
    ],
)
def test_a_key_that_cannot_be_had_is_refused_with_its_reason(viewer, key, reason):
    press(viewer, RESET, key)
    assert reason in errors(viewer)[-1]
    assert keys(viewer, RESET) == ("R", "Home")
    assert viewer.state.preferences.keys == {}


def test_a_key_is_set_cleared_and_put_back(viewer):
    press(viewer, RESET, "Ctrl+W")
    assert keys(viewer, RESET) == ("Ctrl+W",)
    assert ("Ctrl+W", RESET) in rows(viewer.state.preferences.keys)
    assert with_key("Reset", actions.reset_view, viewer.state.preferences.keys) == "Reset (Ctrl+W)"
    keying.clear(viewer, command_of(RESET))
    assert keys(viewer, RESET) == ()
    assert RESET not in [does for _, does in rows(viewer.state.preferences.keys)]
    assert with_key("Reset", actions.reset_view, viewer.state.preferences.keys) == "Reset"
    keying.put_back(viewer, command_of(RESET))
    assert keys(viewer, RESET) == ("R", "Home")
    assert viewer.state.preferences.keys == {}


def test_a_taken_key_is_asked_about_and_swapped_or_left(viewer):
    press(viewer, RESET, "Shift+F")
    conflict = viewer.state.keying.conflict
    assert (conflict.wanted_by, conflict.key, conflict.owner) == (RESET, "Shift+F", FRAME)
    assert viewer.state.preferences.keys == {}
    keying.keep_keys(viewer)
    assert viewer.state.keying.conflict is None
    assert viewer.state.preferences.keys == {}
    press(viewer, RESET, "Shift+F")
    keying.swap(viewer)
    assert keys(viewer, RESET) == ("Shift+F",)
    assert keys(viewer, FRAME) == ("R", "Home")
    assert viewer.state.keying.conflict is None


def test_a_command_may_be_given_its_own_key_alone(viewer):
    press(viewer, RESET, "Home")
    assert viewer.state.keying.conflict is None
    assert keys(viewer, RESET) == ("Home",)


def test_a_key_of_the_table_that_another_was_given_stays_there(viewer):
    press(viewer, RESET, "Shift+F")
    keying.swap(viewer)
    keying.put_back(viewer, command_of(FRAME))
    assert keys(viewer, FRAME) == ()
    assert f"Shift+F is the key of '{RESET}'" in viewer.state.messages[-1].text
    keying.put_all_back(viewer)
    assert keys(viewer, FRAME) == ("Shift+F",)
    assert keys(viewer, RESET) == ("R", "Home")


def test_no_key_ever_does_two_things(viewer):
    """Whatever is swapped with whatever."""
    for wanted, key in ((RESET, "F"), (FRAME, "R"), (RELOAD, "F"), (RESET, "F5"), (FRAME, "F5")):
        press(viewer, wanted, key)
        keying.swap(viewer)
        held = [key for command in COMMANDS for key in keys_of(command, viewer.state.preferences.keys)]
        assert len(held) == len(set(held))
        assert key in keys(viewer, wanted)


def test_a_later_version_that_uses_the_key_leaves_it_to_its_owner(viewer):
    given = {"save the view": ("R",)}
    viewer.state.preferences = replace(viewer.state.preferences, keys=given)
    assert keys(viewer, RESET) == ("Home",)


def test_they_are_remembered(tmp_path):
    kept = Preferences(keys={RESET: ("Ctrl+W", "?"), FRAME: (), "of a later version": ("F9",)})
    save_preferences(tmp_path, kept)
    assert load_preferences(tmp_path) == kept


@pytest.mark.parametrize("value", [3, [], {"a": "R"}, {"a": [3]}, {"a": ["Hyper+R"]}, {"a": ["\x1b"]}])
def test_keys_of_a_file_that_make_no_sense_are_one_line(tmp_path, value):
    (tmp_path / FILE_NAME).write_text(json.dumps({"keys": value}))
    with pytest.raises(InputError, match="keys") as caught:
        load_preferences(tmp_path)
    assert str(caught.value).isprintable()


def test_the_list_is_read_at_first_and_left_without_a_trace(viewer):
    actions.edit_keys(viewer, True)
    assert viewer.state.show_help
    keying.wait_for_key(viewer, command_of(RESET))
    actions.type_keys(viewer, "frame")
    actions.show_help(viewer, False)
    assert viewer.state.keying == Keying()
