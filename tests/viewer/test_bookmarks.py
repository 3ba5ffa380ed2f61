"""Views with names, the six sides, walking."""

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from langsplat_viewer.actions import opening, viewpoint
from langsplat_viewer.camera.controls import OrbitCamera, from_side, look, orbit, symmetric_intrinsics, walk
from langsplat_viewer.files.flights import FILE_NAME, MOST_SCENES, MOST_VIEWS, Shelf
from tests.support.windowless import arrive, errors, settle


def reopen(viewer, name: str = "blobs.ply") -> None:
    opening.open_scene(viewer, Path(name))
    settle(viewer)


def names(viewer) -> list[str]:
    return [bookmark.name for bookmark in viewer.state.bookmarks]


def test_a_bookmark_leads_back_and_is_there_the_next_time(opened, tmp_path):
    opened.shelf = Shelf(tmp_path / "settings")
    viewpoint.move(opened, lambda view: orbit(view, 0.4, 0.1))
    marked = opened.state.view
    viewpoint.add_bookmark(opened, "  the  mug ")
    reopen(opened, "plain.ply")
    assert names(opened) == []
    viewpoint.add_bookmark(opened)
    reopen(opened)
    assert names(opened) == ["the mug"]
    viewpoint.go_to_bookmark(opened, opened.state.bookmarks[0])
    arrive(opened)
    assert_allclose(opened.state.view.eye, marked.eye, atol=1e-9)
    assert_allclose(opened.state.view.rotation, marked.rotation, atol=1e-9)
    assert_allclose(opened.state.view.target, marked.target, atol=1e-9)
    viewpoint.delete_bookmark(opened, opened.state.bookmarks[0])
    reopen(opened)
    assert names(opened) == []
    reopen(opened, "plain.ply")
    assert names(opened) == ["view 1"]


def test_names_are_numbers_or_replaced_and_end_somewhere(opened):
    viewpoint.add_bookmark(opened)
    viewpoint.add_bookmark(opened, "view 2")
    viewpoint.add_bookmark(opened)
    viewpoint.add_bookmark(opened, "view 2")
    assert names(opened) == ["view 1", "view 3", "view 2"]
    for _ in range(MOST_VIEWS):
        viewpoint.add_bookmark(opened)
    assert len(names(opened)) == MOST_VIEWS
    assert "at most" in errors(opened)[-1]


def test_without_a_folder_nothing_is_written(opened, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    viewpoint.add_bookmark(opened, "here")
    assert names(opened) == ["here"]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        '{"version": 2, "scenes": {}}',
        '{"version": 1, "scenes": 3}',
        "SCENE 3",
        'SCENE [{"name": 1}]',
    ],
)
def test_a_file_that_makes_no_sense_is_said_and_kept(opened, tmp_path, text):
    if text.startswith("SCENE "):
        entries = json.loads(text.removeprefix("SCENE "))
        text = json.dumps({"version": 1, "scenes": {str(Path("blobs.ply").absolute()): entries}})
    (tmp_path / FILE_NAME).write_text(text)
    opened.shelf = Shelf(tmp_path)
    reopen(opened)
    assert names(opened) == []
    assert FILE_NAME in errors(opened)[0]
    if '"scenes": {"' not in text:
        viewpoint.add_bookmark(opened, "here")
        assert "not kept" in errors(opened)[-1]
        assert (tmp_path / FILE_NAME).read_text() == text


def test_scenes_that_were_marked_long_ago_are_forgotten(opened, tmp_path):
    shelf = Shelf(tmp_path)
    viewpoint.add_bookmark(opened, "here")
    scenes = {f"/old/{number}.ply": [] for number in range(MOST_SCENES)}
    (tmp_path / FILE_NAME).write_text(json.dumps({"version": 1, "scenes": scenes}))
    shelf.write(Path("/new.ply"), opened.state.bookmarks)
    kept = json.loads((tmp_path / FILE_NAME).read_text())["scenes"]
    assert len(kept) == MOST_SCENES
    assert "/old/0.ply" not in kept
    assert [bookmark.name for bookmark in shelf.read(Path("/new.ply"))] == ["here"]


def view_with_up(up) -> OrbitCamera:
    return OrbitCamera(np.eye(3), np.array([1.0, 2, 3]), 4.0, np.array(up, float), symmetric_intrinsics())


UPS = [(0, -1, 0), (0, 0, 1), (0, 1, 0), (1, 0, 0), (0.6, -0.8, 0)]


@pytest.mark.parametrize("up", UPS)
def test_the_six_sides(up):
    view = view_with_up(up)
    seen = {side: from_side(view, side) for side in ("front", "back", "left", "right", "top", "bottom")}
    for side in seen.values():
        assert_allclose(side.rotation @ side.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(side.rotation) == pytest.approx(1)
        assert_allclose(side.target, view.target)
        assert side.distance == 4.0
    up = np.array(up, float)
    ahead = {name: side.rotation[2] for name, side in seen.items()}
    assert_allclose(ahead["back"], -ahead["front"], atol=1e-12)
    assert_allclose(ahead["left"], -ahead["right"], atol=1e-12)
    assert_allclose(ahead["top"], -up, atol=1e-12)
    assert_allclose(ahead["bottom"], up, atol=1e-12)
    # From the right one stands where the front view has its right; the horizon is level everywhere.
    assert_allclose(seen["right"].eye - view.target, 4 * seen["front"].rotation[0], atol=1e-12)
    for name in ("front", "back", "left", "right"):
        assert_allclose(seen[name].rotation[1], -up, atol=1e-12)
    # From above, what is away from the front is up in the picture; from below it is down.
    assert_allclose(-seen["top"].rotation[1], ahead["front"], atol=1e-12)
    assert_allclose(seen["bottom"].rotation[1], ahead["front"], atol=1e-12)


def test_in_a_scene_of_opencv_the_front_is_the_camera_at_rest():
    assert_allclose(from_side(view_with_up((0, -1, 0)), "front").rotation, np.eye(3), atol=1e-12)


def test_commands_look_from_the_sides(opened):
    target = opened.state.view.target
    viewpoint.look_from(opened, "top")
    arrive(opened)
    assert_allclose(opened.state.view.rotation[2], -opened.state.view.up, atol=1e-9)
    assert_allclose(opened.state.view.target, target)


@pytest.mark.parametrize("pitch", [0.0, 0.7, -1.2])
def test_walking_keeps_the_height_of_the_eye(pitch):
    view = look(view_with_up((0, -1, 0)), 0.5, pitch)
    ahead = walk(view, 0, 0, 2.0)
    step = ahead.eye - view.eye
    assert step @ view.up == pytest.approx(0, abs=1e-12)
    assert np.linalg.norm(step) == pytest.approx(2)
    assert step @ view.rotation[2] > 0
    assert_allclose(walk(view, 1, 0, 0).eye - view.eye, view.rotation[0], atol=1e-9)
    assert_allclose(walk(view, 0, 3, 0).eye - view.eye, 3 * view.up, atol=1e-12)


@pytest.mark.parametrize("side", ["top", "bottom"])
def test_walking_while_looking_down_goes_where_the_pictures_top_points(side):
    view = from_side(view_with_up((0, -1, 0)), side)
    step = walk(view, 0, 0, 1.0).eye - view.eye
    assert_allclose(step, from_side(view, "front").rotation[2], atol=1e-9)


def test_walking_is_chosen(opened):
    viewpoint.toggle_walking(opened)
    assert opened.state.walks
    viewpoint.set_walking(opened, False)
    assert not opened.state.walks
