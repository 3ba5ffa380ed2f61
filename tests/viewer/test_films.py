"""Camera paths as plain maths and in files; films of them, in the window and without one."""

import json
import math
import threading
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import av
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from scipy.spatial.transform import Rotation

from langsplat_core.config import PictureConfig
from langsplat_core.errors import InputError
from langsplat_core.io.cameras import read_cameras
from langsplat_core.io.scenes import save_scene
from langsplat_core.progress import Progress, Report, WorkCancelledError
from langsplat_viewer import output
from langsplat_viewer.actions import editing, opening, queries, saving, settings, viewpoint
from langsplat_viewer.camera.controls import extent_of, from_camera, orbit, zoom
from langsplat_viewer.camera.flight import (
    Flight,
    Keyframe,
    Pose,
    frame_times,
    pose_at,
    pose_of,
    stretched,
    tangents,
    turntable,
)
from langsplat_viewer.output import cameras_of, make_film, write_film
from langsplat_viewer.projects import MOST_KEYFRAMES, read_flight, write_flight
from langsplat_viewer.rendering.request import RenderRequest, plain_request
from langsplat_viewer.state import FrameStats
from langsplat_viewer.viewer import Viewer
from tests.support.fakes import blob_scene
from tests.support.windowless import errors, flight, open_scene, picture, recorded, render_image

# Through their keyframes, smooth between them, at rest where nothing changes.

STEP = 1e-6  # seconds, of numerical velocities


def turned(*rotvec: float) -> np.ndarray:
    return Rotation.from_rotvec(rotvec).as_matrix()


def key(seconds: float, position=(0, 0, 0), rotvec=(0, 0, 0), fov: float = 50.0) -> Keyframe:
    return Keyframe(seconds, Pose(np.array(position, float), turned(*rotvec), fov))


def random_flight(seed: int, count: int) -> Flight:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.3, 2.0, count))
    keys = (key(t, rng.normal(size=3), rng.normal(size=3), rng.uniform(20, 110)) for t in times)
    return Flight(tuple(keys))


def speeds(flight: Flight, at: float) -> np.ndarray:
    """(2, 7) velocities before and after a time: of the position, the orientation, and the field of view."""
    found = []
    for first, second in ((at - STEP, at), (at, at + STEP)):
        a, b = flight.poses(np.array([first, second]))
        turn = Rotation.from_matrix(b.rotation.T @ a.rotation).as_rotvec()
        change = np.concatenate([b.position - a.position, turn, [b.fov_degrees - a.fov_degrees]])
        found.append(change / STEP)
    return np.array(found)


def assert_same(got: Pose, wanted: Pose) -> None:
    assert_allclose(got.position, wanted.position, atol=1e-12)
    assert_allclose(got.rotation, wanted.rotation, atol=1e-12)
    assert got.fov_degrees == pytest.approx(wanted.fov_degrees, abs=1e-9)


@pytest.mark.parametrize("count", [1, 2, 3, 8])
def test_path_passes_through_its_keyframes(count):
    keys = random_flight(count, count).keyframes
    times = [keys[0].seconds - 5, *[k.seconds for k in keys], keys[-1].seconds + 9]
    found = Flight(keys).poses(np.array(times))
    for got, wanted in zip(found, (keys[0], *keys, keys[-1]), strict=True):
        assert_same(got, wanted.pose)
    for wrong in ((), (key(1), key(1)), (key(2), key(1))):  # times must rise
        with pytest.raises(ValueError, match="keyframe"):
            Flight(wrong)


@pytest.mark.parametrize("seed", range(5))
def test_velocities_are_continuous(seed):
    flight = random_flight(seed, 7)
    for inner in flight.keyframes[1:-1]:
        before, after = speeds(flight, inner.seconds)
        assert_allclose(before, after, atol=5e-3)
        assert np.abs(before[:6]).max() > 0.05  # and it does not stop there


def test_an_even_turn_stays_even():
    axis = np.array([1.0, 2, -1]) / math.sqrt(6)
    times = np.array([0.0, 1, 2.5, 3, 5])
    flight = Flight(tuple(key(t, rotvec=0.7 * t * axis) for t in times))
    for t in np.linspace(0, 5, 41):
        assert_allclose(pose_at(flight, t).rotation, turned(*(0.7 * t * axis)), atol=1e-12)


def test_path_rests_between_equal_keyframes():
    """A plain spline would swing beyond and back."""
    there = ((1, 2, 3), (0, 0.5, 0), 40)
    flight = Flight((key(0), key(1, *there), key(4, *there), key(5, (2, 2, 2), (0.3, 0, 0))))
    wanted = flight.keyframes[1].pose
    for pose in flight.poses(np.linspace(1, 4, 31)):
        assert_same(pose, wanted)
    assert_allclose(*speeds(flight, 4.0), atol=5e-3)
    zooms = Flight((key(0, fov=60), key(1, fov=61), key(1.1, fov=20), key(4, fov=20)))
    found = [pose.fov_degrees for pose in zooms.poses(np.linspace(0, 4, 400))]
    assert 20 - 1e-9 <= min(found) <= max(found) <= 61 + 1e-9


@pytest.mark.parametrize("angle", [math.pi, math.pi - 1e-9, math.pi + 1e-9, 3.0])
def test_half_turns(angle):
    flight = Flight((key(0), key(1, rotvec=(0, angle, 0)), key(2, rotvec=(0, 0, angle)), key(3)))
    poses = flight.poses(np.linspace(0, 3, 301))
    for pose in poses:
        assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)
    steps = [np.abs(b.rotation - a.rotation).max() for a, b in pairwise(poses)]
    assert max(steps) < 0.15  # no jump
    assert_allclose(*speeds(flight, 1.0), atol=2e-2)


def test_a_far_keyframe_does_not_move_what_is_near():
    keys = random_flight(3, 8).keyframes
    other = (*keys[:-1], key(keys[-1].seconds, (9, 9, 9), (1, 1, 1)))
    early = keys[4].seconds
    for a, b in zip(*(Flight(k).poses(np.linspace(0, early, 50)) for k in (keys, other)), strict=True):
        assert_same(a, b)


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_extreme_paths_stay_finite(scale):
    rng = np.random.default_rng(5)
    keys = tuple(key(t, scale * rng.normal(size=3), (3.1, 0, 0)) for t in (0, 1e-3, 1, 36_000))
    for pose in Flight(keys).poses(np.linspace(0, 36_000, 500)):
        assert np.isfinite(pose.position).all()
        assert np.isfinite(pose.rotation).all()


def test_keyframes_are_stretched_and_tangents_those_of_a_parabola():
    assert [k.seconds for k in stretched((key(0.5), key(2)), 6)] == [1.5, 6]
    assert stretched((), 3) == ()
    assert [k.seconds for k in stretched((key(0),), 3)] == [0]
    times, start, speed, bend = np.array([0.0, 1.0, 3.0, 3.5]), *np.random.default_rng(1).normal(size=(3, 3))
    places = start + times[:, None] * speed + times[:, None] ** 2 * bend
    found = tangents(times, np.diff(places, axis=0), 1e-9)
    assert_allclose(found[1:-1], (speed + 2 * times[:, None] * bend)[1:-1])


def test_a_turntable_goes_once_around_as_a_drag_does():
    view = from_camera(blob_scene().cameras[0], extent_of(blob_scene()))
    turn = turntable(view, 8.0)
    for t in (0.0, 1.0, 5.5):
        expected = pose_of(orbit(view, 2 * math.pi * t / 8, 0))
        assert_allclose(pose_at(turn, t).position, expected.position, atol=1e-9)
        assert_allclose(pose_at(turn, t).rotation, expected.rotation, atol=1e-9)
    between, wanted = pose_at(turn, 7.9), pose_of(orbit(view, 2 * math.pi * 7.9 / 8, 0))
    assert_allclose(between.rotation, wanted.rotation, atol=1e-9)
    assert np.linalg.norm(between.position - wanted.position) < 1e-4 * view.distance
    assert_allclose(pose_at(turn, 8.0).position, view.eye, atol=1e-9)


def test_times_of_pictures():
    assert_allclose(frame_times(Flight((key(0), key(1))), 4), [0, 0.25, 0.5, 0.75, 1])
    assert_allclose(frame_times(Flight((key(0),)), 30), [0])
    view = from_camera(blob_scene().cameras[0], extent_of(blob_scene()))
    assert_allclose(frame_times(turntable(view, 1), 4), [0, 0.25, 0.5, 0.75])  # the last is the first again
    assert len(frame_times(turntable(view, 0.1), 1)) == 1
    assert len(frame_times(Flight((key(0), key(0.1 * 3))), 10)) == 4  # 0.3 is a little less than 3 tenths


# Camera paths to files and back; files that are none.

POSE = {"position": [0, 0, 0], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "fov_degrees": 50}


def entry(**changed):
    return {"seconds": 0, **POSE, **changed}


def file_of(*entries):
    return {"langsplat_flight": 1, "keyframes": list(entries)}


def test_a_path_is_read_as_it_was_written(tmp_path):
    rotation = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    keys = tuple(
        Keyframe(t, Pose(np.array([t, 0.1, -2e-7]), rotation, 33.3, span))
        for t, span in ((0.0, None), (1 / 3, 4.2), (2.5, None))
    )
    write_flight(tmp_path / "path.json", Flight(keys))
    assert [path.name for path in tmp_path.iterdir()] == ["path.json"]
    for got, wanted in zip(read_flight(tmp_path / "path.json").keyframes, keys, strict=True):
        assert (got.seconds, got.pose.fov_degrees) == (wanted.seconds, wanted.pose.fov_degrees)
        assert got.pose.span == wanted.pose.span
        assert_array_equal(got.pose.position, wanted.pose.position)
        assert_array_equal(got.pose.rotation, wanted.pose.rotation)


@pytest.mark.parametrize(
    "top",
    [
        file_of(),
        file_of(*[entry()] * (MOST_KEYFRAMES + 1)),
        file_of(entry(), entry(seconds=1e-300)),
        file_of(entry(seconds=1e9)),
        file_of(entry(rotation=[[1, 0, 0]] * 3)),
        file_of(entry(fov_degrees=180)),
        file_of(entry(span=1e300)),
    ],
)
def test_path_with_impossible_values_is_refused(tmp_path, top):
    (tmp_path / "path.json").write_text(json.dumps(top))
    with pytest.raises(InputError, match="no camera path"):
        read_flight(tmp_path / "path.json")


# In the window.


def turn(viewer: Viewer, yaw: float) -> None:
    viewpoint.move(viewer, lambda view: orbit(view, yaw, 0.05))


def record_three(viewer: Viewer) -> list:
    """Keyframes at 0, 2 and 4 seconds; returns the views."""
    views = []
    for _ in range(3):
        views.append(viewer.state.open.view)
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
        assert_allclose(opened.state.open.view.eye, view.eye, atol=1e-9)
        assert_allclose(opened.state.open.view.rotation, view.rotation, atol=1e-9)
    assert (opened.state.record.began, opened.state.record.at) == (None, 4)  # it has ended


def test_playing_resumes_loops_and_ends_with_a_drag(opened):
    views = record_three(opened)
    opened.state.record.loops = True
    viewpoint.scrub(opened, 1.0)
    for playing, seconds, at in ((True, 5.0, 2.0), (False, 9.0, 2.0), (True, 0.25, 2.25), (True, 3.75, 2.0)):
        if playing != (opened.state.record.began is not None):
            viewpoint.toggle_playing(opened)
        viewpoint.tick(opened, opened.clock + seconds)  # around, of 4 seconds
        assert opened.state.record.at == pytest.approx(at)
    assert_allclose(opened.state.open.view.eye, views[1].eye, atol=1e-9)
    turn(opened, 0.1)
    view = opened.state.open.view
    viewpoint.tick(opened, opened.clock + 1.0)
    assert opened.state.open.view is view


def test_turntable_comes_back_and_is_undone(opened):
    start = opened.state.open.view
    viewpoint.turn_around(opened)
    viewpoint.set_path_seconds(opened, 4.0)
    viewpoint.toggle_playing(opened)
    began = opened.clock
    viewpoint.tick(opened, began + 2)
    flat = (opened.state.open.view.eye - start.target) + (start.eye - start.target)
    assert_allclose(flat - (flat @ start.up) * start.up, 0, atol=1e-9)  # on the other side
    viewpoint.tick(opened, began + 4)
    assert_allclose(opened.state.open.view.eye, start.eye, atol=1e-9)
    viewpoint.move(opened, lambda view: zoom(view, 0.5, 0.01))
    assert opened.state.record.began is None
    for _ in range(2):  # its duration, and the turn
        editing.undo(opened)
    assert times(opened) == []


def test_keyframes_are_changed_and_changes_undone(opened):
    record_three(opened)
    first, second, third = opened.state.session.keyframes
    viewpoint.put_keyframe(opened, second, replace(second, seconds=5.0))
    assert times(opened) == [0, 4, 5]
    there = replace(second, seconds=4.0)  # where another is
    viewpoint.put_keyframe(opened, opened.state.session.keyframes[2], there)
    assert times(opened) == [0, 4, 4.01]
    viewpoint.put_keyframe(opened, first)
    assert times(opened) == [4, 4.01]
    for expected in ([0, 4, 4.01], [0, 4, 5], [0, 2, 4], [0, 2]):
        editing.undo(opened)
        assert times(opened) == expected
    assert opened.state.session.keyframes == (first, second)
    editing.redo(opened)
    assert opened.state.session.keyframes == (first, second, third)
    viewpoint.put_keyframe(opened, first, replace(first, pose=pose_of(opened.state.open.view)))
    assert_allclose(opened.state.session.keyframes[0].pose.position, opened.state.open.view.eye)
    viewpoint.set_path_seconds(opened, 8)
    assert times(opened) == [0, 4, 8]
    viewpoint.set_path(opened, ())
    assert times(opened) == []
    editing.undo(opened)
    assert times(opened) == [0, 4, 8]


def test_a_path_is_saved_loaded_and_dropped(opened, tmp_path, frames):
    record_three(opened)
    path = saving.save_path(opened, tmp_path)
    assert path.name == "blobs-001.path.json"
    assert (len(read_flight(path).keyframes), opened.state.is_changed) == (3, False)  # a file has it
    viewpoint.set_path(opened, ())
    assert not opened.state.is_changed  # nothing is lost
    opening.open_dropped(opened, [path])
    assert times(opened) == [0, 2, 4]
    assert opened.state.wanted_panel == "Record"
    assert not opened.state.is_changed
    (tmp_path / "bad.path.json").write_text("{}")
    viewpoint.load_path(opened, tmp_path / "bad.path.json")
    assert "no camera path" in errors(opened)[-1]
    assert times(opened) == [0, 2, 4]
    settings.put(opened.state.record, size=(640, 1))
    open_scene(opened, "plain.ply")  # has no path of this one
    assert times(opened) == []
    assert opened.state.record.size == (640, 1)


def test_keyframes_have_thumbnails_where_full_images_are_quick(opened):
    record_three(opened)
    for scale, milliseconds, count in ((0.25, 100.0, 0), (1.0, 300.0, 0), (1.0, 100.0, 1)):
        opened.state.stats = FrameStats(milliseconds, scale=scale)
        assert len(viewpoint.thumbnails(opened)) == count


def test_impossible_recordings_are_refused_in_a_line(viewer, opened, tmp_path, frames):
    viewpoint.toggle_playing(opened)
    saving.save_film(opened, tmp_path)
    saving.save_path(opened, tmp_path)
    record_three(opened)
    opened.state.record.film_file = "film.avi"
    saving.save_film(opened, tmp_path)
    wanted = ["two keyframes", "needs a path", "needs a keyframe", "a film is .mp4"]
    assert [reason in text for reason, text in zip(wanted, errors(opened), strict=True)] == [True] * 4
    assert "--" not in "".join(errors(opened))  # options of the command line
    assert list(tmp_path.iterdir()) == []


def test_films_are_made_beside_the_window(opened, tmp_path, frames, monkeypatch):
    record_three(opened)
    settings.put(opened.state.record, size=(32, 24))
    opened.state.record.fps = 1.0
    request = opened.state.request((32, 24))
    saving.save_film(opened, tmp_path)
    queries.ask(opened, "mug")  # the other worker answers meanwhile, and changes what is shown
    saving.save_film(opened, tmp_path)  # waits for the first, and takes another name
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    opened.state.record.film_file = "~/typed"
    saving.save_film(opened, tmp_path)
    settings.compare(opened, "scenes")
    saving.save_sized_picture(opened, tmp_path)
    saving.save_film(opened, tmp_path)
    said = [message.text for message in opened.state.messages[-2:]]
    assert all("without the compared scene" in text for text in said)
    recorded(opened)
    assert [len(list((tmp_path / name).glob("*.png"))) for name in ("blobs-film-002", "typed")] == [5, 5]
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
    gate = threading.Event()
    opened.recorder.submit("next", lambda progress: gate.set(), lambda done: None, opened.say_error)
    opened.recorder.cancel(waiting=False)
    recorded(opened)
    opened.recorder.close(10.0)
    assert len(list(tmp_path.glob("blobs-film-001/*.png"))) < 121
    assert gate.is_set()  # what waited behind it was done
    assert not list(tmp_path.glob("**/.*"))


# Images and views to files.


def test_a_saved_view_can_be_read_again(opened, tmp_path):
    opened.state.size = (321, 123)
    camera = read_cameras(saving.save_view(opened, tmp_path))[0]
    expected = opened.state.open.view.camera(321, 123)
    assert (camera.width, camera.height) == (321, 123)
    assert_allclose(camera.world_to_camera, expected.world_to_camera, atol=1e-9)
    assert camera.fx == pytest.approx(expected.fx)
    (tmp_path / "file").write_text("not a folder")
    for save in (saving.save_picture, saving.save_view):
        assert save(opened, tmp_path / "file") is None
    assert ["not saved" in text and "Errno" not in text for text in errors(opened)] == [True, True]
    opened.state.open = replace(opened.state.open, path=tmp_path / "blobs.ply")
    assert saving.save_view(opened, tmp_path / "gone").parent == tmp_path  # beside the scene


SIZE = (32, 24)
FRAMES = [f"frame-{number:05d}.png" for number in range(5)]


def request() -> RenderRequest:
    scene = blob_scene()
    return plain_request(scene, scene.cameras[0].resized(*SIZE), PictureConfig())


def seen(away: float = 0.0) -> tuple:
    return cameras_of(flight(away), extent_of(blob_scene()), 4.0, SIZE)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with a scene and two paths in it."""
    save_scene(tmp_path / "blobs.ply", blob_scene(phrasebook=True))
    write_flight(tmp_path / "path.json", flight())
    write_flight(tmp_path / "away.json", flight(1.0))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def program(run_viewer):
    """Runs the program without a window, on the CPU."""
    return lambda *arguments: run_viewer(*arguments, "--headless", "--backend", "cpu")


def test_a_film_is_a_folder_of_pictures(program, folder):
    (folder / "film").mkdir()
    for left in ("film.json", "frame-00007.png"):  # by a longer film
        (folder / "film" / left).write_bytes(b"")
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


def test_pictures_of_others_are_not_overwritten(program, folder):
    (folder / "film").mkdir()
    (folder / "film" / FRAMES[0]).write_bytes(b"mine")
    code, _, err = program("blobs.ply", "--path", "path.json", "--out", "film")
    assert (code, len(err)) == (2, 1)
    assert "frame-00000.png of another program" in err[0]
    assert (folder / "film" / FRAMES[0]).read_bytes() == b"mine"


def test_without_pyav_a_video_becomes_a_folder(program, folder, caplog, monkeypatch):
    monkeypatch.setattr(output, "has_video", lambda: False)
    code, out, _ = program("blobs.ply", "--turntable", "1", "--fps", "2", "--size", "32x24", "--out", "a.mp4")
    assert (code, out) == (0, ["a/: 32x24, 2 pictures, 2 a second"])
    assert len(caplog.messages) == 1  # it is said
    assert not (folder / "a.mp4").exists()


def test_a_video_has_the_images_at_their_rate(program, folder):
    assert make_film(request(), seen(), 4.0, Path("a.mp4"), "cpu") == ["a.mp4: 32x24, 5 pictures, 4 a second"]
    with av.open("a.mp4") as container:
        (stream,) = container.streams
        assert (stream.codec_context.name, stream.average_rate) == ("h264", 4)
        images = [frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(stream)]
    assert len(images) == 5
    expected = render_image(request().seen_by(seen()[4]), "cpu")
    assert np.abs(images[4] - expected).mean() < 6  # colours of 2 x 2 pixels are one
    with pytest.raises(WorkCancelledError):  # a stopped video leaves nothing
        make_film(request(), seen(), 4.0, folder / "b.mp4", "cpu", Progress(stop))
    assert [path.name for path in folder.iterdir() if path.suffix == ".mp4"] == ["a.mp4"]


def test_unwritable_films_leave_the_earlier_one(folder):
    (folder / "a.mp4").write_bytes(b"old")
    with pytest.raises(InputError, match=r"a\.mp4: no video .*; name a folder"):
        write_film(folder / "a.mp4", 2, 4.0, lambda number: np.zeros((25, 33, 3), np.uint8))
    assert (folder / "a.mp4").read_bytes() == b"old"
    assert not [path for path in folder.iterdir() if path.name.startswith(".a")]
    out = folder / "film"
    write_film(out, 2, 2.0, lambda number: np.zeros((3, 4, 3), np.uint8))

    def fails(number: int) -> np.ndarray:
        raise InputError("nothing to draw")

    with pytest.raises(InputError):
        write_film(out, 1, 2.0, fails)
    assert len(list(out.glob("frame-*.png"))) == 2
    write_film(out, 1, 2.0, lambda number: np.zeros((3, 4, 3), np.uint8))
    assert len(list(out.glob("frame-*.png"))) == 1


def test_film_of_nothing_is_refused(folder):
    with pytest.raises(InputError, match="no picture of the film shows anything"):
        make_film(request(), seen(away=1.0), 4.0, folder / "a.mp4", "cpu")
    assert not (folder / "a.mp4").exists()
    keys = (*flight().keyframes, Keyframe(2.0, flight(1.0).keyframes[2].pose))
    seen_by = cameras_of(Flight(keys), extent_of(blob_scene()), 2.0, SIZE)
    lines = make_film(request(), seen_by, 2.0, folder / "a.mp4", "cpu")
    assert lines[1].endswith("of 5 pictures show nothing of the scene")
