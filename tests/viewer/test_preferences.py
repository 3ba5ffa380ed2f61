"""What one window leaves for the next."""

from dataclasses import replace
from pathlib import Path

import pytest

from langsplat_core.errors import InputError
from langsplat_viewer.actions import settings
from langsplat_viewer.files.preferences import (
    FILE_NAME,
    MOST_RECENT,
    SCALES,
    Preferences,
    load_preferences,
    preferences_folder,
    save_preferences,
    with_recent,
)


def test_they_come_back_as_they_were(tmp_path):
    assert load_preferences(tmp_path / "none") == Preferences()
    kept = Preferences("light", 1.5, ("/a/b.ply", "/ü.ply"), ("Search",))
    save_preferences(tmp_path / "new" / "folder", kept)
    assert load_preferences(tmp_path / "new" / "folder") == kept


def test_what_a_later_version_adds_is_left_alone(tmp_path):
    (tmp_path / FILE_NAME).write_text('{"theme": "light", "colour": "mauve"}')
    assert load_preferences(tmp_path) == Preferences(theme="light")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{",
        '{"theme": "pink"}',
        '{"theme": []}',
        '{"ui_scale": 0}',
        '{"ui_scale": NaN}',
        '{"ui_scale": true}',
        '{"ui_scale": "large"}',
        '{"recent": 3}',
        '{"recent": [3]}',
        '{"recent": null}',
        '{"panels": "Search"}',
        "[" * 100_000,
        "\xff\xfe",
    ],
)
def test_a_file_that_makes_no_sense_is_one_line(tmp_path, text):
    (tmp_path / FILE_NAME).write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=FILE_NAME) as caught:
        load_preferences(tmp_path)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 300


def test_recent_scenes_are_not_listed_twice_nor_without_end():
    preferences = Preferences()
    for number in (*range(MOST_RECENT + 3), 5):
        preferences = with_recent(preferences, Path(f"/{number}.ply"))
    assert len(preferences.recent) == MOST_RECENT
    assert preferences.recent[:2] == ("/5.ply", f"/{MOST_RECENT + 2}.ply")


def test_they_lie_in_the_platforms_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert preferences_folder().name == "langsplat-viewer"


def test_looks_are_chosen_within_limits(viewer):
    settings.set_theme(viewer, "light")
    settings.set_ui_scale(viewer, 99.0)
    assert viewer.state.preferences == replace(Preferences(), theme="light", ui_scale=SCALES[1])
