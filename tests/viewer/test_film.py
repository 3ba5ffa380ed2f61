"""Films without a window: as folders, animations and videos; begun again, stopped, refused."""

from itertools import pairwise
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from langsplat_core.config import PictureConfig
from langsplat_core.errors import InputError
from langsplat_core.io.scenes import save_scene
from langsplat_core.progress import Progress, Report, WorkCancelledError
from langsplat_viewer import output
from langsplat_viewer.camera.controls import extent_of
from langsplat_viewer.camera.flight import Flight, Keyframe
from langsplat_viewer.files.projects import write_flight
from langsplat_viewer.output import Film, Shot, cameras_of, make_film, write_film
from langsplat_viewer.rendering.renderer import render_image
from langsplat_viewer.rendering.request import RenderRequest, plain_request
from tests.support.fakes import blob_scene
from tests.support.windowless import flight

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
def viewer(run_viewer):
    """Runs the program without a window, on the CPU."""
    return lambda *arguments: run_viewer(*arguments, "--headless", "--backend", "cpu")


def test_a_film_is_a_folder_of_pictures(viewer, folder):
    code, out, err = viewer(
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


def test_pictures_of_others_are_not_overwritten(viewer, folder):
    (folder / "film").mkdir()
    (folder / "film" / FRAMES[0]).write_bytes(b"mine")
    code, _, err = viewer("blobs.ply", "--path", "path.json", "--out", "film")
    assert (code, len(err)) == (2, 1)
    assert "frame-00000.png of another program" in err[0]
    assert (folder / "film" / FRAMES[0]).read_bytes() == b"mine"


@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_animations(viewer, folder, suffix):
    out = f"film{suffix}"
    arguments = ["--turntable", "1", "--fps", "5", "--size", "32x24", "--out", out]
    code, lines, err = viewer("blobs.ply", *arguments)
    assert (code, lines, err) == (0, [f"{out}: 32x24, 5 pictures, 5 a second"], [])
    image = Image.open(folder / out)
    assert (image.n_frames, image.size) == (5, SIZE)
    assert sorted(path.suffix for path in folder.iterdir() if "film" in path.name) == [suffix]


@pytest.mark.parametrize("flat", [[], ["--orthographic", "3"]])
def test_a_turntable_around_the_answer_has_it_in_the_middle(viewer, folder, flat):
    arguments = ["--query", "plant", "--turntable", "1", "--fps", "4", "--size", "64x48", "--display", "rgb"]
    assert viewer("blobs.ply", *arguments, *flat, "--around", "answer", "--out", "film")[0] == 0
    for name in FRAMES[:4]:
        middle = picture(folder / "film" / name)[20:28, 28:36]
        assert middle.mean((0, 1)).argmax() == 2  # the plant is blue
    code, _, err = viewer("blobs.ply", "--turntable", "1", "--around", "answer", "--out", "film")
    assert code == 2
    assert "nothing was found" in err[0]


def test_without_pyav_a_video_becomes_a_folder(viewer, folder, caplog, monkeypatch):
    monkeypatch.setattr(output, "has_video", lambda: False)
    code, out, _ = viewer("blobs.ply", "--turntable", "1", "--fps", "2", "--size", "32x24", "--out", "a.mp4")
    assert (code, out) == (0, ["a/: 32x24, 2 pictures, 2 a second"])
    assert len(caplog.messages) == 1  # it is said
    assert not (folder / "a.mp4").exists()


def test_a_video_has_the_images_at_their_rate(viewer, folder):
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


def test_a_video_of_odd_sides_is_refused(viewer, folder):
    code, _, err = viewer("blobs.ply", "--turntable", "1", "--size", "33x24", "--out", "a.mp4")
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
def test_impossible_options_are_one_line(viewer, folder, arguments, reason):
    before = sorted(folder.rglob("*"))
    code, out, err = viewer("blobs.ply", *arguments)
    assert (code, out, len(err)) == (2, [], 1)
    assert reason in err[0]
    assert sorted(folder.rglob("*")) == before


def test_orthographic_turntable_begins_with_the_shown_view(viewer, folder):
    arguments = ["--orthographic", "3", "--size", "64x48", "--query", "plant", "--display", "rgb"]
    for more in (["--turntable", "1", "--fps", "4", "--out", "film"], ["--out", "still.png"]):
        assert viewer("blobs.ply", *arguments, *more)[0] == 0
    first, still = picture(folder / "film" / FRAMES[0]), picture(folder / "still.png")
    assert still.std() > 10
    np.testing.assert_allclose(first, still, atol=2)
    assert np.abs(picture(folder / "film" / FRAMES[1]) - still).max() > 30
