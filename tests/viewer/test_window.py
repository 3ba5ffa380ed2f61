"""The program: pictures without a window, refusals as one line, and the window on a virtual display."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.config import PictureConfig
from langsplat_core.io.cameras import write_cameras
from langsplat_core.io.scenes import save_scene
from langsplat_core.scene import Camera, Scene
from langsplat_viewer import options
from langsplat_viewer.options import load_text_encoder, parse_size
from langsplat_viewer.projects import write_flight
from tests.support.fakes import CENTRES, blob_scene
from tests.support.processes import Cast, play, python, surroundings
from tests.support.scenes import with_tree
from tests.support.windowless import flight, picture

MUG, BOOK, PLANT = CENTRES


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with scenes in it."""
    save_scene(tmp_path / "blobs.ply", with_tree(blob_scene(phrasebook=True)))
    save_scene(tmp_path / "old.ply", blob_scene())
    save_scene(tmp_path / "plain.ply", blob_scene(field=False, with_cameras=False))
    save_scene(tmp_path / "nothing.ply", blob_scene().take(np.arange(0)))
    write_flight(tmp_path / "path.json", flight())
    (tmp_path / "broken.json").write_text('[{"width": 12')
    (tmp_path / "empty.json").write_text("[]")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def draw(run_viewer, out: str, *arguments: str) -> list[str]:
    """Return what is said of a picture of the blobs that is drawn without a window."""
    code, said, errors = run_viewer("blobs.ply", "--headless", "--out", out, *arguments)
    assert (code, errors) == (0, [])
    return said


def colour_at(image: np.ndarray, camera: Camera, point: np.ndarray) -> np.ndarray:
    pixels, _ = camera.project(point[None])
    column, row = pixels[0].astype(int)
    return image[row - 2 : row + 3, column - 2 : column + 3].reshape(-1, 3).mean(0)


def test_headless_image_uses_the_first_camera(run_viewer, folder):
    assert draw(run_viewer, "a.png") == ["a.png: 160x120, rgb"]
    image, camera = picture(folder / "a.png"), blob_scene().cameras[0]
    assert image.shape == (120, 160, 3)
    assert [colour_at(image, camera, p).argmax() for p in (MUG, BOOK, PLANT)] == [0, 1, 2]
    draw(run_viewer, "b.png", "--size", "400x120")  # holds the whole photograph
    wide = picture(folder / "b.png")
    assert wide.shape == (120, 400, 3)
    np.testing.assert_allclose(wide[:, 120:280], image, atol=1)
    write_cameras(folder / "view.json", (blob_scene().cameras[2],))
    draw(run_viewer, "c.png", "--camera", "2")
    draw(run_viewer, "d.png", "--camera", "view.json")
    np.testing.assert_array_equal(picture(folder / "c.png"), picture(folder / "d.png"))


def test_headless_query_prints_and_paints_answers(run_viewer, folder):
    draw(run_viewer, "rgb.png", "--camera", "1")
    out = draw(run_viewer, "a.png", "--query", "plant", "--query", "Book", "--camera", "1")
    assert out[0] == "a.png: 160x120, relevancy"
    assert out[1].startswith("'plant': found")
    assert "level whole" in out[1]
    place = np.array([float(v) for v in out[1].partition("place (")[2].rstrip(")").split(",")])
    np.testing.assert_allclose(place, PLANT, atol=0.2)
    assert out[2].startswith("'Book': found")
    camera = blob_scene().cameras[1]
    before, heat = picture(folder / "rgb.png"), picture(folder / "a.png")
    assert colour_at(heat, camera, PLANT)[2] < 60 < colour_at(before, camera, PLANT)[2]
    dimmed = PictureConfig().dim * colour_at(before, camera, MUG)  # what is not asked for
    np.testing.assert_allclose(colour_at(heat, camera, MUG), dimmed, atol=4)
    out = draw(run_viewer, "a.png", "--query", "mug", "--level", "part")
    assert "not here" in out[1]
    assert "level part" in out[1]


def test_transparent_image_in_another_colour_map(run_viewer, folder):
    (line,) = draw(run_viewer, "a.png", "--display", "depth")
    near, far = (float(line.split()[place]) for place in (3, 6))  # depth 1.2 units to 3.4 units
    _, depths = blob_scene().cameras[0].project(np.array([MUG, BOOK, PLANT]))
    assert near < depths.min() < depths.max() < far < 1.5 * depths.max()
    draw(run_viewer, "b.png", "--display", "depth", "--colour-map", "cividis", "--transparent")
    plain, clear = picture(folder / "a.png"), picture(folder / "b.png")
    assert (plain.shape[2], clear.shape[2]) == (3, 4)
    inside = clear[..., 3] == 255
    assert 0.01 < inside.mean() < 0.9
    assert (clear[~inside] == 0).all()
    assert np.abs(clear[..., :3][inside] - plain[inside]).max() > 60


def test_orthographic_image_has_the_asked_scale(run_viewer, folder):
    """Three units across 120 pixels; each blob is as large as the others, however far away."""
    assert draw(run_viewer, "a.png", "--orthographic", "3") == ["a.png: 160x120, rgb"]
    image, camera = picture(folder / "a.png"), blob_scene().cameras[0]
    sizes, middles = [], []
    for colour in range(3):
        columns = np.nonzero(image[..., colour] - np.delete(image, colour, -1).max(-1) > 40)[1]
        sizes.append(len(columns))
        middles.append(columns.mean())
    assert max(sizes) < 1.3 * min(sizes)
    along = float((PLANT - MUG) @ camera.rotation[0])
    assert abs(middles[2] - middles[0] - along * 120 / 3) < 4


def test_scene_without_cameras_is_framed(run_viewer, folder):
    code, out, _ = run_viewer("plain.ply", "--headless", "--out", "new/folder/a.png", "--size", "96x64")
    assert (code, out) == (0, ["new/folder/a.png: 96x64, rgb"])
    covered = (picture(folder / "new/folder/a.png").max(-1) > 40).mean()
    assert 0.02 < covered < 0.9


IMAGE = ["--headless", "--out", "a.png"]
REFUSED = [  # words, and why
    *(
        ([*arguments, *IMAGE], reason)
        for arguments, reason in [
            (["nope.ply"], "nope.ply: no such file"),
            (["nothing.ply"], "the scene holds no Gaussians"),
            (["blobs.ply", "--query", "sofa"], "'sofa'"),
            (["blobs.ply", "--camera", "3"], "cameras 0 to 2"),
            (["blobs.ply", "--camera", "nope.json"], "nope.json: no such file"),
            (["blobs.ply", "--camera", "broken.json"], "broken.json"),
            (["blobs.ply", "--camera", "empty.json"], "holds no camera"),
            (["plain.ply", "--camera", "0"], "no training cameras"),
            (["plain.ply", "--query", "mug"], "langsplat train"),
            (["plain.ply", "--display", "latent"], "langsplat train"),
            (["old.ply", "--display", "tree"], "keeps no tree"),
            (["blobs.ply", "--display", "segmentation"], "add --query"),
            (["blobs.ply", "--display", "pretty"], "pretty"),
            (["blobs.ply", "--size", "99999x10"], "1280x720"),
            (["blobs.ply", "--headles"], "--headles"),
            (["blobs.ply", "plain.ply"], "plain.ply"),
            (["blobs.ply", "--orthographic", "0"], "--orthographic 0: must be 1e-09 to 1e+09"),
        ]
    ),
    *(
        (["blobs.ply", *arguments], reason)
        for arguments, reason in [
            (["--headless"], "add --out"),
            (["--headless", "--out", "a.jpg"], "end the name in .png"),
            (["--headless", "--out", "folder.png"], "is a folder"),
            (["--out", "a.png"], "with --headless"),
            (["--transparent"], "with --headless"),
            (["--headless", "--fps", "9", "--out", "a.png"], "--fps: is only used with --path or"),
            (["--headless", "--path", "path.json"], "--out film.mp4"),
            (["--headless", "--path", "path.json", "--out", "a.png"], "a film is .mp4"),
        ]
    ),
    *(
        (["blobs.ply", "--headless", *arguments, "--out", "a.mp4"], reason)
        for arguments, reason in [
            (["--path", "path.json", "--turntable", "3"], "choose one"),
            (["--path", "path.json", "--orthographic", "2"], "--orthographic is for one view"),
            (["--path", "broken.json"], "broken.json"),
            (["--turntable", "0"], "--turntable 0"),
            (["--turntable", "36000", "--fps", "240"], "choose fewer a second"),
            (["--turntable", "1", "--size", "33x24"], "choose 32x24"),
        ]
    ),
]


@pytest.mark.parametrize(("arguments", "reason"), REFUSED)
def test_impossible_options_are_one_line(run_viewer, folder, arguments, reason):
    (folder / "folder.png").mkdir()
    before = sorted(folder.rglob("*"))
    code, out, err = run_viewer(*arguments)
    assert (code, out, len(err)) == (2, [], 1)
    assert reason in err[0]
    assert err[0].startswith("langsplat-viewer: ")
    assert sorted(folder.rglob("*")) == before


def test_absent_encoder_is_one_line(run_viewer, monkeypatch, folder):
    monkeypatch.setattr(options, "load_text_encoder", load_text_encoder)
    code, _, errors = run_viewer("blobs.ply", "--headless", "--out", "a.png", "--query", "mug")
    assert (code, len(errors)) == (2, 1)
    assert "fake" in errors[0]
    assert not (folder / "a.png").exists()


def run_python(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Of a process without a display, but for one that is given."""
    inherited = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    return subprocess.run(
        [sys.executable, *arguments], env=inherited | environment, capture_output=True, text=True, timeout=120
    )


@pytest.mark.long
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the message is about X11")
@pytest.mark.parametrize("display", [{}, {"DISPLAY": ":987"}])
def test_missing_display_suggests_headless(folder, display):
    run = run_python("-m", "langsplat_viewer", "blobs.ply", **display)
    assert (run.returncode, len(run.stderr.splitlines())) == (2, 1), run.stderr
    assert "--headless" in run.stderr


WINDOWLESS = """
import sys
from pathlib import Path
from langsplat_core.display import composing
from langsplat_viewer.options import load_scene, warm_up
from langsplat_viewer.program import entry
warm_up(load_scene(Path("blobs.ply")), "cpu")
kernels = [kernel for kernel in vars(composing).values() if hasattr(kernel, "signatures")]
compiled = [len(kernel.signatures) for kernel in kernels]
sys.argv = "langsplat-viewer blobs.ply --query book --headless --backend cpu --out a.png".split()
try:
    entry()
except SystemExit as stop:
    assert not stop.code, stop.code
assert compiled == [len(kernel.signatures) for kernel in kernels] != [0] * len(kernels), compiled
print([name for name in ("glfw", "imgui_bundle", "torch", "transformers", "open3d") if name in sys.modules])
"""


@pytest.mark.long
def test_headless_loads_no_windowing_library(folder):
    """Nor compiles anything that the window has compiled before its first image."""
    run = run_python("-c", WINDOWLESS)
    assert run.returncode == 0, run.stderr
    assert run.stdout.splitlines()[-1] == "[]"
    assert (folder / "a.png").exists()


@pytest.mark.parametrize(
    ("text", "size"), [("", None), ("1280x720", (1280, 720)), ("1X16384", (1, 16384)), (" 3×4 ", (3, 4))]
)
def test_sizes(text, size):
    assert parse_size(text) == size


# The window: scenarios, idling, closing, orbiting, memory.

SCENARIOS = [
    "look_and_search", "without_field", "from_the_command_line", "broken_renderer", "use_shortcuts",
    "arrange_panels", "many_queries", "select_with_the_mouse", "outline_and_rest", "ask_before_leaving",
    "drag_the_gizmo", "travel_by_keys", "end_by_signals", "look_at_nothing", "record_and_play",
    "close_while_opening", "split_the_view", "draw_over_the_scene", "look_without_perspective",
    "reload_what_changed", "search_a_library", "see_the_evidence", "large_letters", "use_the_toolbar",
    "drag_the_crop_box", "pin_a_note", "open_many_scenes", "use_the_outline", "compare_two_scenes",
    "offers_keep_still", "say_what_is_not_here", "begin_at_the_start_page", "toasts_offer_what_follows",
    "choose_in_the_systems_dialog", "export_from_the_menu", "do_without_a_mouse", "broken_panel",
    "use_the_mouse_alone",
]  # fmt: skip


@pytest.fixture(scope="module")
def cast(display: str) -> Iterator[Cast]:
    """Plays scenarios of `window_driver`."""
    made = Cast("tests.viewer.window_driver", display)
    yield made
    made.close()


@pytest.fixture
def scenes(tmp_path: Path) -> Path:
    """Scenes with and without a language field, one cut short, and one of which nothing can be drawn."""
    for name, field in (("blobs", True), ("plain", False)):
        save_scene(tmp_path / f"{name}.ply", replace(blob_scene(field=field), path=None))
    gaussians = replace(blob_scene().gaussians, opacity_logits=np.full(360, np.nan))
    save_scene(tmp_path / "nothing.ply", Scene(gaussians))
    whole = (tmp_path / "plain.ply").read_bytes()
    (tmp_path / "truncated.ply").write_bytes(whole[: len(whole) // 2])
    return tmp_path


@pytest.mark.long
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_window(scenario: str, cast: Cast, scenes: Path):
    drive(scenario, cast, scenes)


@pytest.mark.long
def test_layout_is_remembered(cast: Cast, scenes: Path):
    drive("leave_settings", cast, scenes)
    drive("find_settings", cast, scenes)


def drive(scenario: str, cast: Cast, scenes: Path) -> None:
    """Play one scenario of `window_driver`."""
    said = cast.play([scenario, str(scenes)], scenes, timeout=300)
    assert said.rstrip().endswith("PASSED"), said[-4000:]


DEMO = Path(__file__).parents[2] / "assets" / "demo" / "scene.ply"


def run(display: str, folder: Path, *arguments: str) -> str:
    """Return what `process_driver` prints."""
    return play(display, ["-m", "tests.viewer.process_driver", *arguments], folder, 200)


@pytest.fixture
def blobs(tmp_path: Path) -> str:
    save_scene(tmp_path / "blobs.ply", blob_scene())
    return str(tmp_path / "blobs.ply")


@pytest.mark.long
def test_idle_window_draws_nothing(display, tmp_path, blobs):
    words = run(display, tmp_path, "idle", "--scene", blobs).split()
    assert int(words[1]) <= 2  # one in a hundred seconds, and a late one
    assert float(words[3]) < 0.01
    assert min(map(int, words[5::2])) >= 3  # after news, however slow they are: widgets take their places


@pytest.mark.long
def test_closing_does_not_wait_for_reading(display, tmp_path, blobs):
    run(display, tmp_path, "leave", "--scene", blobs)  # in less than the ten minutes that the reading takes


@pytest.mark.long
def test_fast_keys_keep_their_order(display, tmp_path):
    save_scene(tmp_path / "many.ply", blob_scene(phrasebook=True))
    assert "PASSED" in run(display, tmp_path, "type", "--scene", str(tmp_path / "many.ply"))


@pytest.mark.long
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="says where settings are")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_an_idle_window(display, tmp_path, blobs, number):
    process = subprocess.Popen(
        [sys.executable, "-m", "langsplat_viewer", blobs],
        env=surroundings(display) | {"XDG_CONFIG_HOME": str(tmp_path)},
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
    )
    while not (tmp_path / "langsplat-viewer" / "preferences.json").exists():  # the scene is a recent one
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.2)
    time.sleep(2)  # and it rests
    process.send_signal(number)
    assert process.wait(100) == 0, process.communicate()[1]


@pytest.mark.long
@pytest.mark.skipif(shutil.which("nvidia-smi") is not None, reason="needs a machine without CUDA")
def test_absent_backend_is_refused_before_a_window(display, tmp_path, blobs):
    words, env = ("-m", "langsplat_viewer", blobs, "--fresh", "--backend", "cuda"), surroundings(display)
    done = python(*words, env=env, cwd=tmp_path, timeout=300)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "cuda" in done.stderr.lower()


@pytest.mark.long
def test_images_are_coarse_while_moving_only(display, tmp_path):
    options = ["--scene", str(DEMO), "--count", "0", "--seconds", "2", "--size", "860", "620", "--slow"]
    seen = json.loads(run(display, tmp_path, *options))
    assert len(seen["sharp_after"]) == 3
    if seen["backend"] == "cpu":
        assert all(width < 250 for width, _ in seen["sizes"])  # a quarter of what the panels leave
        assert seen["merged"] == [True] * 3
