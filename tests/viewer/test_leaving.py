"""Saving what is selected, the rest and the scene; and what is asked before deletions are lost."""

import os
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from langsplat_core.io import load_scene
from langsplat_viewer.actions import opening, selecting, settings, undoing
from langsplat_viewer.actions.selecting import take
from tests.support.fakes import COLOURS
from tests.support.selected import blob, marked
from tests.support.windowless import SCENES, errors, settle


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def without_plant(viewer) -> None:
    take(viewer, blob("plant"))
    selecting.delete_selected(viewer)


def test_the_selection_and_the_rest_are_scenes_with_their_field(opened, tmp_path):
    without_plant(opened)
    take(opened, blob("mug"))
    for part, word in (("selection", "mug"), ("rest", "book")):
        selecting.export(opened, tmp_path, part)
        settle(opened)
        assert f"saved {tmp_path / f'blobs-{part}-001.ply'}: 120 Gaussians" == opened.state.messages[-1].text
        written = load_scene(tmp_path / f"blobs-{part}-001.ply")
        np.testing.assert_array_equal(
            written.gaussians.means, SCENES["blobs.ply"].gaussians.means[blob(word)]
        )
        assert len(written.language) == 120
        assert len(written.cameras) == 3
    assert opened.state.selection.is_unsaved  # neither is the scene


def test_points_have_their_colours(opened, tmp_path):
    take(opened, blob("mug"))
    selecting.export(opened, tmp_path, "selection", as_points=True)
    settle(opened)
    assert names_in(tmp_path) == ["blobs-selection-points-001.ply"]
    table = PlyData.read(tmp_path / "blobs-selection-points-001.ply")["vertex"]
    assert len(table) == 120
    np.testing.assert_allclose([table["red"][0], table["blue"][0]], 255 * COLOURS[0, [0, 2]], atol=1)


def test_nothing_is_ever_written_over(opened, tmp_path):
    take(opened, blob("mug"))
    taken = tmp_path / "blobs-selection-001.langsplat.safetensors"  # what would belong to the first name
    taken.write_text("precious")
    for _ in range(2):  # both are asked for before either is written
        selecting.export(opened, tmp_path, "selection")
    settle(opened)
    assert taken.read_text() == "precious"
    assert [name for name in names_in(tmp_path) if name.endswith(".ply")] == [
        "blobs-selection-002.ply",
        "blobs-selection-003.ply",
    ]


def test_what_cannot_be_written_is_said(opened, tmp_path):
    selecting.export(opened, tmp_path, "selection")
    assert "nothing is selected" in opened.state.messages[-1].text
    selecting.select_all(opened)
    selecting.export(opened, tmp_path, "rest")
    assert "the rest holds no Gaussians" in errors(opened)[-1]
    (tmp_path / "file").write_text("")
    selecting.export(opened, tmp_path / "file", "selection")
    settle(opened)
    assert errors(opened)[-1].startswith("not saved: ")
    assert names_in(tmp_path) == ["file"]


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_is_locked(opened, tmp_path):
    tmp_path.chmod(0o500)
    without_plant(opened)
    selecting.export(opened, tmp_path, "edited")
    settle(opened)
    assert "not saved" in errors(opened)[-1]
    assert opened.state.selection.is_unsaved


def test_deleting_is_unsaved_until_the_scene_is_saved(opened, tmp_path):
    selection = lambda: opened.state.selection  # noqa: E731  replaced at every change
    assert not selection().is_unsaved
    without_plant(opened)
    assert selection().is_unsaved
    undoing.undo(opened)
    assert not selection().is_unsaved
    undoing.redo(opened)
    selecting.export(opened, tmp_path, "edited")
    settle(opened)
    assert not selection().is_unsaved
    assert len(load_scene(tmp_path / "blobs-edited-001.ply").gaussians) == 240
    take(opened, blob("mug"))
    selecting.delete_selected(opened)
    assert selection().is_unsaved


def test_another_scene_waits_for_the_answer(opened, tmp_path):
    without_plant(opened)
    opening.open_scene(opened, Path("plain.ply"))
    assert opened.state.opening is None
    assert opened.state.selection.leaving.to == "plain.ply is opened"
    selecting.stay(opened)
    settle(opened)
    assert (opened.state.path.name, opened.state.selection.leaving) == ("blobs.ply", None)
    assert marked(opened) == ("", "", "plant")

    opening.open_scene(opened, Path("plain.ply"))
    settings.escape(opened)
    assert opened.state.selection.leaving is None

    opening.open_scene(opened, Path("plain.ply"))
    selecting.discard_and_leave(opened)
    settle(opened)
    assert opened.state.path.name == "plain.ply"
    assert names_in(tmp_path) == []


def test_saving_comes_before_what_waited(opened, tmp_path):
    without_plant(opened)
    then = []
    opening.open_scene(opened, Path("plain.ply"), then.append)
    selecting.save_and_leave(opened, tmp_path)
    settle(opened)
    settle(opened)
    assert then == [opened]
    assert opened.state.path.name == "plain.ply"
    assert len(load_scene(tmp_path / "blobs-edited-001.ply").gaussians) == 240


def test_where_saving_fails_nothing_is_left(opened, tmp_path):
    without_plant(opened)
    selecting.quit_viewer(opened)
    (tmp_path / "file").write_text("")
    selecting.save_and_leave(opened, tmp_path / "file")
    settle(opened)
    assert "not saved" in errors(opened)[-1]
    assert not opened.state.selection.may_close
    assert opened.state.selection.is_unsaved


def test_a_broken_scene_after_discarding_loses_nothing(opened):
    without_plant(opened)
    opening.open_scene(opened, Path("broken.ply"))
    selecting.discard_and_leave(opened)
    settle(opened)
    assert marked(opened) == ("", "", "plant")
    assert opened.state.selection.is_unsaved


def test_the_window_closes_at_once_or_asks(opened):
    without_plant(opened)
    assert not selecting.may_close(opened)
    assert opened.state.selection.leaving.to == "the window closes"
    selecting.stay(opened)
    undoing.undo(opened)
    assert selecting.may_close(opened)


def test_a_window_without_a_scene_closes(viewer):
    assert selecting.may_close(viewer)


def test_what_is_being_written_is_waited_for(opened, tmp_path):
    selecting.finish_writing(opened)  # nothing is
    take(opened, blob("mug"))
    selecting.export(opened, tmp_path, "selection")
    selecting.finish_writing(opened)
    assert "blobs-selection-001.ply" in names_in(tmp_path)
