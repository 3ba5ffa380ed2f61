"""Camera paths, films and saved images, as actions of the window."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image

from langsplat_core.io.cameras import read_cameras
from langsplat_viewer import output
from langsplat_viewer.actions import editing, opening, queries, saving, settings, viewpoint
from langsplat_viewer.camera.controls import orbit, zoom
from langsplat_viewer.files.projects import read_flight
from langsplat_viewer.rendering.renderer import render_image
from langsplat_viewer.viewer import Viewer
from tests.support.windowless import errors, open_scene, recorded


def turn(viewer: Viewer, yaw: float) -> None:
    viewpoint.move(viewer, lambda view: orbit(view, yaw, 0.05))


def record_three(viewer: Viewer) -> list:
    """Keyframes at 0, 2 and 4 seconds; returns the views."""
    views = []
    for _ in range(3):
        views.append(viewer.state.view)
        viewpoint.add_keyframe(viewer)
        turn(viewer, 0.3)
    return views


def times(viewer: Viewer) -> list[float]:
    return [key.seconds for key in viewer.state.session.keyframes]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(output, "has_video", lambda: False)
    monkeypatch.setattr(saving, "has_video", lambda: False)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_played_path_goes_through_its_keyframes(opened):
    views = record_three(opened)
    assert times(opened) == [0, 2, 4]
    viewpoint.scrub(opened, 0)
    viewpoint.tick(opened, 100.0)
    viewpoint.toggle_playing(opened)
    for seconds, view in zip((0, 2, 4), views, strict=True):
        viewpoint.tick(opened, 100.0 + seconds)
        assert_allclose(opened.state.view.eye, view.eye, atol=1e-9)
        assert_allclose(opened.state.view.rotation, view.rotation, atol=1e-9)
    assert opened.state.record.began is None  # it has ended
    assert opened.state.record.at == 4


def test_playing_resumes_loops_and_ends_with_a_drag(opened):
    views = record_three(opened)
    opened.state.record.loops = True
    viewpoint.scrub(opened, 1.0)
    for playing, seconds, at in ((True, 5.0, 2.0), (False, 9.0, 2.0), (True, 0.25, 2.25), (True, 3.75, 2.0)):
        if playing != (opened.state.record.began is not None):
            viewpoint.toggle_playing(opened)
        viewpoint.tick(opened, opened.clock + seconds)  # around, of 4 seconds
        assert opened.state.record.at == pytest.approx(at)
    assert_allclose(opened.state.view.eye, views[1].eye, atol=1e-9)
    turn(opened, 0.1)
    view = opened.state.view
    viewpoint.tick(opened, opened.clock + 1.0)
    assert opened.state.view is view


def test_a_turntable_comes_back_and_begins_anew_after_a_drag(opened):
    start = opened.state.view
    viewpoint.set_turning(opened, True)
    viewpoint.set_path_seconds(opened, 4.0)
    viewpoint.toggle_playing(opened)
    began = opened.clock
    viewpoint.tick(opened, began + 2)
    assert_allclose(opened.state.view.target, start.target)
    flat = (opened.state.view.eye - start.target) + (start.eye - start.target)
    assert_allclose(flat - (flat @ start.up) * start.up, 0, atol=1e-9)  # on the other side
    viewpoint.tick(opened, began + 4)
    assert_allclose(opened.state.view.eye, start.eye, atol=1e-9)
    viewpoint.move(opened, lambda view: zoom(view, 0.5, 0.01))
    assert opened.state.record.turn_from is None
    assert opened.state.record.at == 0


def test_keyframes_are_changed_and_changes_undone(opened):
    record_three(opened)
    first, second, third = opened.state.session.keyframes
    viewpoint.move_keyframe(opened, second, 5.0)
    assert times(opened) == [0, 4, 5]
    viewpoint.move_keyframe(opened, opened.state.session.keyframes[2], 4.0)  # there is one
    assert times(opened) == [0, 4, 4.01]
    viewpoint.delete_keyframe(opened, first)
    assert times(opened) == [4, 4.01]
    for expected in ([0, 4, 4.01], [0, 4, 5], [0, 2, 4], [0, 2]):
        editing.undo(opened)
        assert times(opened) == expected
    assert opened.state.session.keyframes == (first, second)
    editing.redo(opened)
    assert opened.state.session.keyframes == (first, second, third)
    viewpoint.replace_keyframe(opened, first)
    assert_allclose(opened.state.session.keyframes[0].pose.position, opened.state.view.eye)
    viewpoint.set_path_seconds(opened, 8)
    assert times(opened) == [0, 4, 8]
    viewpoint.clear_path(opened)
    assert times(opened) == []
    editing.undo(opened)
    assert times(opened) == [0, 4, 8]


def test_a_path_is_saved_loaded_and_dropped(opened, folder):
    record_three(opened)
    path = saving.save_path(opened, folder)
    assert path.name == "blobs-001.path.json"
    assert len(read_flight(path).keyframes) == 3
    viewpoint.clear_path(opened)
    opening.open_dropped(opened, [path])
    assert times(opened) == [0, 2, 4]
    assert opened.state.wanted_panel == "Record"
    (folder / "bad.path.json").write_text("{}")
    viewpoint.load_path(opened, folder / "bad.path.json")
    assert "no camera path" in errors(opened)[-1]
    assert times(opened) == [0, 2, 4]
    settings.put(opened.state.record, size=(640, 1))
    open_scene(opened, "plain.ply")  # has no path of this one
    assert times(opened) == []
    assert opened.state.record.size == (640, 1)


def test_impossible_recordings_are_refused_in_a_line(viewer, opened, folder):
    viewpoint.toggle_playing(opened)
    saving.save_film(opened, folder)
    saving.save_path(opened, folder)
    record_three(opened)
    opened.state.record.film_file = "film.avi"
    saving.save_film(opened, folder)
    wanted = ["two keyframes", "needs a path", "needs a keyframe", "a film is .mp4"]
    assert [reason in text for reason, text in zip(wanted, errors(opened), strict=True)] == [True] * 4
    assert list(folder.iterdir()) == []


def test_a_film_is_made_beside_the_window(opened, folder):
    record_three(opened)
    settings.put(opened.state.record, size=(32, 24))
    opened.state.record.fps = 1.0
    request = opened.state.request((32, 24))
    saving.save_film(opened, folder)
    queries.ask(opened, "mug")  # the other worker answers meanwhile, and changes what is shown
    recorded(opened)
    assert "blobs-film-001/: 32x24, 5 pictures" in " ".join(m.text for m in opened.state.messages)
    seen = sorted((folder / "blobs-film-001").glob("*.png"))
    assert len(seen) == 5
    camera = opened.state.session.keyframes[1].pose.camera(32, 24)
    expected = render_image(request.seen_by(camera), "cpu")
    np.testing.assert_array_equal(np.asarray(Image.open(seen[2])), expected)


def test_a_film_can_be_stopped(opened, folder):
    record_three(opened)
    settings.put(opened.state.record, size=(320, 240))
    saving.save_film(opened, folder)
    saving.cancel_film(opened)
    recorded(opened)
    opened.recorder.close(10.0)
    assert len(list(folder.glob("blobs-film-001/*.png"))) < 121
    assert not list(folder.glob("**/.*"))


# Images and views to files.


def test_pictures_are_saved_under_new_names(opened, tmp_path):
    first, second = saving.save_picture(opened, tmp_path), saving.save_picture(opened, tmp_path)
    assert [first.name, second.name] == ["blobs-001.png", "blobs-002.png"]
    assert np.asarray(Image.open(second)).tolist() == np.full((6, 8, 3), 77).tolist()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["blobs-001.png", "blobs-002.png"]


def test_a_saved_view_can_be_read_again(opened, tmp_path):
    opened.state.size = (321, 123)
    camera = read_cameras(saving.save_view(opened, tmp_path))[0]
    expected = opened.state.view.camera(321, 123)
    assert (camera.width, camera.height) == (321, 123)
    assert_allclose(camera.world_to_camera, expected.world_to_camera, atol=1e-9)
    assert camera.fx == pytest.approx(expected.fx)
    (tmp_path / "file").write_text("not a folder")
    for save in (saving.save_picture, saving.save_view):
        assert save(opened, tmp_path / "file") is None
    assert ["not saved" in text for text in errors(opened)] == [True, True]
