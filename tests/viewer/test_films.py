"""Camera paths and films: in the window, and without one as folders, animations and videos."""

from itertools import pairwise
from pathlib import Path

import av
import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image

from langsplat_core.config import PictureConfig
from langsplat_core.errors import InputError
from langsplat_core.io.cameras import read_cameras
from langsplat_core.io.scenes import save_scene
from langsplat_core.progress import Progress, Report, WorkCancelledError
from langsplat_viewer import output
from langsplat_viewer.actions import editing, opening, queries, saving, settings, viewpoint
from langsplat_viewer.camera.controls import extent_of, orbit, zoom
from langsplat_viewer.camera.flight import Flight, Keyframe
from langsplat_viewer.output import Film, Shot, cameras_of, make_film, write_film
from langsplat_viewer.projects import read_flight, write_flight
from langsplat_viewer.rendering.request import RenderRequest, plain_request
from langsplat_viewer.viewer import Viewer
from tests.support.fakes import blob_scene
from tests.support.windowless import errors, flight, open_scene, recorded, render_image


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
def frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Films are folders of images."""
    monkeypatch.setattr(output, "has_video", lambda: False)


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


def test_a_path_is_saved_loaded_and_dropped(opened, tmp_path, frames):
    record_three(opened)
    path = saving.save_path(opened, tmp_path)
    assert path.name == "blobs-001.path.json"
    assert len(read_flight(path).keyframes) == 3
    viewpoint.clear_path(opened)
    opening.open_dropped(opened, [path])
    assert times(opened) == [0, 2, 4]
    assert opened.state.wanted_panel == "Record"
    (tmp_path / "bad.path.json").write_text("{}")
    viewpoint.load_path(opened, tmp_path / "bad.path.json")
    assert "no camera path" in errors(opened)[-1]
    assert times(opened) == [0, 2, 4]
    settings.put(opened.state.record, size=(640, 1))
    open_scene(opened, "plain.ply")  # has no path of this one
    assert times(opened) == []
    assert opened.state.record.size == (640, 1)


def test_impossible_recordings_are_refused_in_a_line(viewer, opened, tmp_path, frames):
    viewpoint.toggle_playing(opened)
    saving.save_film(opened, tmp_path)
    saving.save_path(opened, tmp_path)
    record_three(opened)
    opened.state.record.film_file = "film.avi"
    saving.save_film(opened, tmp_path)
    wanted = ["two keyframes", "needs a path", "needs a keyframe", "a film is .mp4"]
    assert [reason in text for reason, text in zip(wanted, errors(opened), strict=True)] == [True] * 4
    assert list(tmp_path.iterdir()) == []


def test_a_film_is_made_beside_the_window(opened, tmp_path, frames):
    record_three(opened)
    settings.put(opened.state.record, size=(32, 24))
    opened.state.record.fps = 1.0
    request = opened.state.request((32, 24))
    saving.save_film(opened, tmp_path)
    queries.ask(opened, "mug")  # the other worker answers meanwhile, and changes what is shown
    recorded(opened)
    assert "blobs-film-001/: 32x24, 5 pictures" in " ".join(m.text for m in opened.state.messages)
    seen = sorted((tmp_path / "blobs-film-001").glob("*.png"))
    assert len(seen) == 5
    camera = opened.state.session.keyframes[1].pose.camera(32, 24)
    expected = render_image(request.seen_by(camera), "cpu")
    np.testing.assert_array_equal(np.asarray(Image.open(seen[2])), expected)


def test_a_film_can_be_stopped(opened, tmp_path, frames):
    record_three(opened)
    settings.put(opened.state.record, size=(320, 240))
    saving.save_film(opened, tmp_path)
    saving.cancel_film(opened)
    recorded(opened)
    opened.recorder.close(10.0)
    assert len(list(tmp_path.glob("blobs-film-001/*.png"))) < 121
    assert not list(tmp_path.glob("**/.*"))


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


SIZE = (32, 24)
FRAMES = [f"frame-{number:05d}.png" for number in range(5)]


def request() -> RenderRequest:
    scene = blob_scene()
    return plain_request(scene, scene.cameras[0].resized(*SIZE), PictureConfig())


def shot(away: float = 0.0, **changed) -> Shot:
    given = {"fps": 4.0, "backend": "cpu", **changed}
    return Shot(request(), cameras_of(flight(away), extent_of(blob_scene()), given["fps"], SIZE), **given)


def picture(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with a scene and two paths in it."""
    save_scene(tmp_path / "blobs.ply", blob_scene(phrasebook=True))
    write_flight(tmp_path / "path.json", flight())
    write_flight(tmp_path / "away.json", flight(1.0))
    (tmp_path / "broken.json").write_text('{"langsplat_flight": 1}')
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def program(run_viewer):
    """Runs the program without a window, on the CPU."""
    return lambda *arguments: run_viewer(*arguments, "--headless", "--backend", "cpu")


def test_a_film_is_a_folder_of_pictures(program, folder):
    code, out, err = program(
        "blobs.ply", "--path", "path.json", "--out", "film", "--fps", "4", "--size", "32x24", "--query", "mug"
    )
    assert (code, err) == (0, [])
    assert out[0] == "film/: 32x24, 5 pictures, 4 a second"
    assert out[1].startswith("'mug': found")
    assert sorted(path.name for path in (folder / "film").iterdir()) == ["film.json", *FRAMES]
    seen = [picture(folder / "film" / name) for name in FRAMES]
    assert all(np.abs(a - b).max() > 30 for a, b in pairwise(seen))


def stop(at: Report) -> None:
    if at.fraction > 0.5:
        raise WorkCancelledError


def test_a_folder_is_filled_anew(folder):
    make_film(shot(), folder / "film")
    make_film(shot(fps=2.0), folder / "film")
    assert sorted(path.name for path in (folder / "film").iterdir()) == ["film.json", *FRAMES[:3]]


def test_pictures_of_others_are_not_overwritten(program, folder):
    (folder / "film").mkdir()
    (folder / "film" / FRAMES[0]).write_bytes(b"mine")
    code, _, err = program("blobs.ply", "--path", "path.json", "--out", "film")
    assert (code, len(err)) == (2, 1)
    assert "frame-00000.png of another program" in err[0]
    assert (folder / "film" / FRAMES[0]).read_bytes() == b"mine"


@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_animations(program, folder, suffix):
    out = f"film{suffix}"
    arguments = ["--turntable", "1", "--fps", "5", "--size", "32x24", "--out", out]
    code, lines, err = program("blobs.ply", *arguments)
    assert (code, lines, err) == (0, [f"{out}: 32x24, 5 pictures, 5 a second"], [])
    image = Image.open(folder / out)
    assert (image.n_frames, image.size) == (5, SIZE)
    assert sorted(path.suffix for path in folder.iterdir() if "film" in path.name) == [suffix]


def test_without_pyav_a_video_becomes_a_folder(program, folder, caplog, monkeypatch):
    monkeypatch.setattr(output, "has_video", lambda: False)
    code, out, _ = program("blobs.ply", "--turntable", "1", "--fps", "2", "--size", "32x24", "--out", "a.mp4")
    assert (code, out) == (0, ["a/: 32x24, 2 pictures, 2 a second"])
    assert len(caplog.messages) == 1  # it is said
    assert not (folder / "a.mp4").exists()


def test_a_video_has_the_images_at_their_rate(program, folder):
    assert make_film(shot(), Path("a.mp4")) == ["a.mp4: 32x24, 5 pictures, 4 a second"]
    with av.open("a.mp4") as container:
        (stream,) = container.streams
        assert (stream.codec_context.name, stream.average_rate) == ("h264", 4)
        images = [frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(stream)]
    assert len(images) == 5
    expected = render_image(request().seen_by(shot().cameras[4]), "cpu")
    assert np.abs(images[4] - expected).mean() < 6  # colours of 2 x 2 pixels are one
    with pytest.raises(WorkCancelledError):  # a stopped video leaves nothing
        make_film(shot(), folder / "b.mp4", Progress(stop))
    assert [path.name for path in folder.iterdir() if path.suffix == ".mp4"] == ["a.mp4"]


def test_a_video_of_odd_sides_is_refused(program, folder):
    code, _, err = program("blobs.ply", "--turntable", "1", "--size", "33x24", "--out", "a.mp4")
    assert (code, len(err)) == (2, 1)
    assert "choose 32x24" in err[0]


def test_a_video_that_cannot_be_written_is_one_line(folder):
    (folder / "a.mp4").write_bytes(b"old")
    film = Film(folder / "a.mp4", 2, (33, 25), 4.0)
    with pytest.raises(InputError, match=r"a\.mp4: no video .*; use --out folder/"):
        write_film(film, lambda number: np.zeros((25, 33, 3), np.uint8))
    assert (folder / "a.mp4").read_bytes() == b"old"
    assert not [path for path in folder.iterdir() if path.name.startswith(".a")]


def test_film_of_nothing_is_refused(folder):
    with pytest.raises(InputError, match="no picture of the film shows anything"):
        make_film(shot(away=1.0), folder / "a.gif")
    assert not (folder / "a.gif").exists()
    keys = (*flight().keyframes, Keyframe(2.0, flight(1.0).keyframes[2].pose))
    cameras = cameras_of(Flight(keys), extent_of(blob_scene()), 2.0, SIZE)
    lines = make_film(Shot(request(), cameras, 2.0, "cpu"), folder / "a.gif")
    assert lines[1].endswith("of 5 pictures show nothing of the scene")


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--path", "path.json", "--turntable", "3", "--out", "a.gif"], "choose one"),
        (["--path", "path.json", "--orthographic", "2", "--out", "a.gif"], "--orthographic is for one view"),
        (["--path", "path.json"], "--out film.mp4"),
        (["--path", "path.json", "--out", "a.png"], "a film is .mp4"),
        (["--path", "broken.json", "--out", "a.gif"], "broken.json"),
        (["--path", "nope.json", "--out", "a.gif"], "nope.json: no such file"),
        (["--turntable", "0", "--out", "a.gif"], "--turntable 0"),
        (["--turntable", "3", "--fps", "0", "--out", "a.gif"], "--fps 0"),
        (["--turntable", "36000", "--fps", "240", "--out", "a.gif"], "lower --fps"),
        (["--turntable", "1", "--out", "blobs.ply/film"], "is a file"),
    ],
)
def test_impossible_options_are_one_line(program, folder, arguments, reason):
    before = sorted(folder.rglob("*"))
    code, out, err = program("blobs.ply", *arguments)
    assert (code, out, len(err)) == (2, [], 1)
    assert reason in err[0]
    assert sorted(folder.rglob("*")) == before


def test_failed_film_leaves_the_earlier_one_in_its_folder(tmp_path):
    write_film(Film(tmp_path, 2, (4, 3), 2.0), lambda number: np.zeros((3, 4, 3), np.uint8))

    def fails(number: int) -> np.ndarray:
        raise InputError("nothing to draw")

    with pytest.raises(InputError):
        write_film(Film(tmp_path, 1, (4, 3), 2.0), fails)
    assert len(list(tmp_path.glob("frame-*.png"))) == 2
    write_film(Film(tmp_path, 1, (4, 3), 2.0), lambda number: np.zeros((3, 4, 3), np.uint8))
    assert len(list(tmp_path.glob("frame-*.png"))) == 1
