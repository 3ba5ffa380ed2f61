"""The file browser, without a window."""

from pathlib import Path

import pytest

from langsplat_viewer.actions import opening, settings
from langsplat_viewer.files.browsing import MOST_LISTED, Entry, list_folder
from langsplat_viewer.panels.scene import in_words
from tests.support.windowless import SCENES, errors, settle


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Scenes, folders, and what is neither."""
    (tmp_path / "B folder").mkdir()
    (tmp_path / "sog folder").mkdir()
    (tmp_path / "sog folder" / "meta.json").write_text("{}")
    for name in ("a.ply", "Z.SPZ", "notes.txt", ".hidden.ply"):
        (tmp_path / name).write_bytes(b"12345")
    return tmp_path


def test_folders_come_first_and_what_is_no_scene_is_left_out(folder):
    listing = list_folder(folder)
    listed = [(entry.path.name, entry.is_file, entry.size) for entry in listing.entries]
    assert listed == [
        ("B folder", False, 0),
        ("a.ply", True, 5),
        ("sog folder", True, 0),
        ("Z.SPZ", True, 5),
    ]
    assert not listing.problem


def test_a_folder_that_cannot_be_listed_says_why(tmp_path):
    assert "No such file" in list_folder(tmp_path / "gone").problem
    assert "Not a directory" in list_folder(_file(tmp_path)).problem


def _file(folder: Path) -> Path:
    path = folder / "file"
    path.write_bytes(b"")
    return path


def test_a_crowded_folder_is_cut(tmp_path, monkeypatch):
    monkeypatch.setattr("langsplat_viewer.files.browsing.MOST_LISTED", 3)
    for number in range(5):
        (tmp_path / f"{number}.ply").write_bytes(b"")
    listing = list_folder(tmp_path)
    assert (len(listing.entries), listing.left_out) == (3, 2)
    assert MOST_LISTED > 100


def test_one_goes_into_folders_and_opens_scenes(viewer, folder, monkeypatch):
    monkeypatch.chdir(folder)
    opening.ask_for_file(viewer)
    assert viewer.state.browser.folder == folder
    opening.choose(viewer, Entry(folder / "B folder", is_file=False))
    assert viewer.state.browser.folder == folder / "B folder"
    opening.browse(viewer, folder)
    opening.choose(viewer, Entry(folder / "blobs.ply", is_file=True))
    assert viewer.state.browser is None
    settle(viewer)
    assert viewer.state.scene is SCENES["blobs.ply"]
    opening.ask_for_file(viewer)
    assert viewer.state.browser.folder == folder  # that of the scene
    settings.escape(viewer)
    assert viewer.state.browser is None


@pytest.mark.parametrize("typed", [" blobs.ply ", "B folder/../blobs.ply"])
def test_a_path_can_be_typed(viewer, folder, monkeypatch, typed):
    monkeypatch.chdir(folder)
    opening.ask_for_file(viewer)
    for nothing in ("", "  "):
        opening.type_path(viewer, nothing)
        opening.open_typed(viewer)
        assert viewer.state.browser is not None
    opening.type_path(viewer, "B folder")
    opening.open_typed(viewer)
    assert viewer.state.browser.folder == folder / "B folder"
    assert viewer.state.path_typed == ""
    opening.browse(viewer, folder)
    opening.type_path(viewer, typed)
    opening.open_typed(viewer)
    settle(viewer)
    assert viewer.state.scene is SCENES["blobs.ply"]


@pytest.mark.parametrize("typed", ["gone.ply", "x" * 5000, "~nobody-of-this-name/a.ply"])
def test_a_path_that_leads_nowhere_is_an_error_line(viewer, folder, monkeypatch, typed):
    monkeypatch.chdir(folder)
    opening.ask_for_file(viewer)
    opening.type_path(viewer, typed)
    opening.open_typed(viewer)
    settle(viewer)
    assert len(errors(viewer)) == 1


def test_scenes_that_were_open_are_remembered_the_latest_first(viewer):
    for name in ("blobs.ply", "plain.ply", "blobs.ply"):
        opening.open_scene(viewer, Path(name))
        settle(viewer)
    recent = viewer.state.preferences.recent
    assert [Path(path).name for path in recent] == ["blobs.ply", "plain.ply"]
    assert all(Path(path).is_absolute() for path in recent)
    opening.open_recent(viewer, recent[1])
    settle(viewer)
    assert viewer.state.scene is SCENES["plain.ply"]


def test_sizes_in_words():
    said = [in_words(size) for size in (0, 999, 1400, 123_456, 2.5e9, 7e15)]
    assert said == ["0 bytes", "999 bytes", "1.4 kB", "123 kB", "2.5 GB", "7000 TB"]
