"""What buttons and keys do, without a window: a fake picture, fake files, a fake text encoder."""

import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image

from langsplat_core.errors import EncoderError, FormatError, InputError
from langsplat_core.formats.cameras_json import read_cameras
from langsplat_core.scene import Scene
from langsplat_viewer import actions, saving
from langsplat_viewer.actions import Services, Viewer
from langsplat_viewer.state import GLIDE_SECONDS, MAX_MESSAGES, ViewerState
from tests.support.fakes import CENTRES, FakeEncoder, blob_scene

SCENES = {
    "blobs.ply": blob_scene(),
    "plain.ply": blob_scene(field=False),
    "bare.ply": blob_scene(with_cameras=False),
    "book.ply": blob_scene(phrasebook=True),
}


class FakeSurface:
    """A picture of one colour whose surface is a plane through the origin."""

    def point_at(self, u: float, v: float):
        return None if u > 0.9 else np.array([u - 0.5, v - 0.5, 0.0])

    def capture(self, state: ViewerState):
        return np.full((6, 8, 3), 77, np.uint8)


def load(path: Path) -> Scene:
    if path.name not in SCENES:
        raise FormatError(f"{path}: broken; export it again")
    return SCENES[path.name]


def settle(viewer: Viewer, seconds: float = 10.0) -> None:
    """Frames until the worker has nothing left to do."""
    end = time.monotonic() + seconds
    while viewer.worker.current is not None:
        assert time.monotonic() < end, "the worker never finished"
        actions.tick(viewer, 0.0)
        time.sleep(0.002)
    actions.tick(viewer, 0.0)


def arrive(viewer: Viewer) -> None:
    """Let a gliding camera arrive."""
    actions.tick(viewer, viewer.clock + 2 * GLIDE_SECONDS)


@pytest.fixture
def viewer():
    made = Viewer(Services(load, lambda encoder_id: FakeEncoder()), surface=FakeSurface())
    yield made
    made.worker.close()


@pytest.fixture
def opened(viewer):
    actions.open_scene(viewer, Path("blobs.ply"))
    settle(viewer)
    return viewer


def errors(viewer: Viewer) -> list[str]:
    return [message.text for message in viewer.state.messages if message.is_error]


# --- Opening


def test_open_shows_the_scene_from_its_first_camera(opened):
    state = opened.state
    assert state.scene is SCENES["blobs.ply"]
    assert state.opening is None
    assert state.latent.shape == (3, 360, 3)
    assert state.camera_index == 0
    assert_allclose(
        state.view.camera(160, 120).world_to_camera, state.scene.cameras[0].world_to_camera, atol=1e-9
    )


def test_unusable_gaussians_are_counted(viewer):
    scene = blob_scene(field=False)
    scene.gaussians.means[[3, 7]] = np.nan
    viewer.services = replace(viewer.services, load_scene=lambda path: scene)
    actions.open_scene(viewer, Path("holes.ply"))
    settle(viewer)
    assert viewer.state.messages[0].text == "holes.ply: 360 Gaussians; not drawn: 2 with position not finite"
    assert np.isfinite(viewer.state.view.camera(160, 120).world_to_camera).all()


def test_a_broken_file_leaves_the_open_scene_alone(opened):
    before = opened.state.view
    actions.open_scene(opened, Path("broken.ply"))
    settle(opened)
    assert opened.state.scene is SCENES["blobs.ply"]
    assert opened.state.view is before
    assert opened.state.opening is None
    assert errors(opened) == ["broken.ply: broken; export it again"]


def test_opening_another_scene_forgets_the_queries(opened):
    actions.ask(opened, "mug")
    settle(opened)
    actions.open_scene(opened, Path("bare.ply"))
    settle(opened)
    assert opened.state.queries == []
    assert opened.state.camera_index is None


def test_a_scene_without_language_field_says_what_makes_one(viewer):
    actions.set_display(viewer, "relevancy")
    actions.open_scene(viewer, Path("plain.ply"))
    settle(viewer)
    assert viewer.state.picture.display == "rgb"
    assert "langsplat train" in viewer.state.messages[-1].text
    actions.ask(viewer, "mug")
    actions.set_display(viewer, "latent")
    assert viewer.state.queries == []
    assert viewer.state.picture.display == "rgb"
    assert "langsplat train" in errors(viewer)[-1]


def test_the_window_stays_responsive_while_a_scene_is_read(viewer):
    release = threading.Event()

    def slow(path: Path) -> Scene:
        assert release.wait(10)
        return SCENES["blobs.ply"]

    viewer.services = replace(viewer.services, load_scene=slow)
    actions.open_scene(viewer, Path("blobs.ply"))
    actions.tick(viewer, 0.0)  # returns although the file is still being read
    assert viewer.state.scene is None
    assert viewer.worker.current[0] == "opening blobs.ply"
    release.set()
    settle(viewer)
    assert viewer.state.scene is not None


def test_cancelled_opening_shows_nothing(viewer):
    release = threading.Event()

    def slow(path: Path) -> Scene:
        assert release.wait(10)
        return SCENES["blobs.ply"]

    viewer.services = replace(viewer.services, load_scene=slow)
    actions.open_scene(viewer, Path("blobs.ply"))
    actions.cancel(viewer)
    assert viewer.worker.current is None
    assert viewer.state.opening is None
    release.set()
    viewer.worker.submit("after it", lambda progress: None, lambda nothing: None, pytest.fail)
    settle(viewer)
    assert viewer.state.scene is None


# --- Queries


def test_a_query_is_answered_and_shown(opened):
    actions.ask(opened, "  mug ")
    query = opened.state.queries[0]
    assert query.pending
    settle(opened)
    assert (query.phrase, query.slot, query.pending, query.problem) == ("mug", 0, False, "")
    assert query.result.found
    assert query.result.level == 2
    assert_allclose(query.result.place, CENTRES[0], atol=0.25)
    assert opened.state.picture.display == "relevancy"
    columns = opened.state.relevancies()
    assert columns.shape == (360, 1)
    assert columns[:120].mean() > 0.9 > 0.6 > columns[120:].mean()
    assert opened.state.heat_peaks() == (query.result.peak,)


def test_an_absent_thing_is_not_here(opened):
    actions.ask(opened, "mug")
    actions.set_level(opened, "part")
    settle(opened)
    assert not opened.state.queries[0].result.found


def test_an_unknown_word_is_one_line(opened):
    actions.ask(opened, "sofa")
    settle(opened)
    query = opened.state.queries[0]
    assert query.result is None
    assert "sofa" in query.problem
    assert "\n" not in query.problem
    assert opened.state.shown() == []


def test_an_unexpected_error_of_the_encoder_is_one_line_too(opened):
    def broken(encoder_id: str):
        raise ZeroDivisionError("deep\ninside")

    opened.answers._load_encoder = broken
    actions.ask(opened, "mug")
    settle(opened)
    assert opened.state.queries[0].problem == "internal error: ZeroDivisionError: deep inside"
    actions.set_display(opened, "depth")  # and life goes on
    assert opened.state.picture.display == "depth"


def test_phrasebook_needs_no_encoder(viewer):
    def absent(encoder_id: str):
        raise EncoderError("no weights; download them")

    viewer.services = replace(viewer.services, load_encoder=absent)
    actions.open_scene(viewer, Path("book.ply"))
    settle(viewer)
    actions.ask(viewer, "Book")
    actions.ask(viewer, "mug")
    settle(viewer)
    book, mug = viewer.state.queries
    assert book.result.found
    assert mug.problem == "no weights; download them"


def test_the_encoder_of_the_command_line_comes_before_the_scenes(viewer):
    asked = []

    def load_encoder(encoder_id: str) -> FakeEncoder:
        asked.append(encoder_id)
        return FakeEncoder()

    viewer.services = Services(load, load_encoder, "mine")
    actions.open_scene(viewer, Path("blobs.ply"))
    settle(viewer)
    actions.ask(viewer, "mug")
    actions.ask(viewer, "book")
    settle(viewer)
    assert asked == ["mine"]  # once for both


def test_empty_and_repeated_phrases(opened):
    actions.ask(opened, "   ")
    assert opened.state.queries == []
    actions.ask(opened, "mug")
    actions.ask(opened, "Mug")
    settle(opened)
    assert [query.phrase for query in opened.state.queries] == ["mug"]


def test_a_fourth_query_takes_the_oldest_ones_colour(opened):
    for word in ("mug", "book", "plant"):
        actions.ask(opened, word)
    settle(opened)
    assert [query.slot for query in opened.state.queries] == [0, 1, 2]
    actions.ask(opened, "mug book")
    settle(opened)
    slots = {query.phrase: query.slot for query in opened.state.queries}
    assert slots == {"mug": None, "book": 1, "plant": 2, "mug book": 0}


def test_hiding_keeps_the_colours_of_the_others(opened):
    for word in ("mug", "book"):
        actions.ask(opened, word)
    settle(opened)
    mug, book = opened.state.queries
    actions.hide(opened, mug)
    columns = opened.state.relevancies()
    assert columns.shape == (360, 2)
    assert not columns[:, 0].any()
    assert columns[120:240, 1].mean() > 0.9
    actions.show(opened, mug)
    assert (mug.slot, book.slot) == (0, 1)
    actions.remove(opened, book)
    assert opened.state.relevancies().shape == (360, 1)
    actions.remove(opened, mug)
    assert opened.state.relevancies() is None


def test_level_applies_to_every_query(opened):
    actions.ask(opened, "plant")
    settle(opened)
    assert opened.state.queries[0].result.level == 2
    key = opened.state.layers_key()
    actions.set_level(opened, "part")
    settle(opened)
    assert opened.state.queries[0].result.level == 1
    assert opened.state.layers_key() != key


def test_asking_before_a_scene_is_open(viewer):
    actions.ask(viewer, "mug")
    assert "open a scene" in errors(viewer)[0]


# --- Display


def test_layers_change_only_when_the_picture_needs_others(opened):
    state = opened.state
    key = state.layers_key()
    actions.set_display(opened, "depth")
    assert state.layers_key() == key
    assert state.latent_rgb() is None
    actions.set_display(opened, "latent", 2)
    assert state.layers_key() != key
    assert_allclose(state.latent_rgb(), state.latent[2])
    actions.set_display(opened, "latent", 1)
    assert_allclose(state.latent_rgb(), state.latent[1])


# --- Camera


def test_focus_brings_the_latest_result_found_to_the_centre(opened):
    for word in ("mug", "plant", "sofa"):
        actions.ask(opened, word)
    settle(opened)
    actions.focus_result(opened)
    arrive(opened)
    place = opened.state.queries[1].result.place
    pixels, depth = opened.state.view.camera(160, 120).project(place[None])
    assert_allclose(pixels[0], (80, 60), atol=1e-6)
    assert 0 < depth[0] < 5


def test_focus_on_one_of_several_results(opened):
    for word in ("mug", "plant"):
        actions.ask(opened, word)
    settle(opened)
    actions.focus_result(opened, opened.state.queries[0])
    arrive(opened)
    assert_allclose(opened.state.view.target, opened.state.queries[0].result.place)


def test_focus_without_a_result_is_the_scenes_middle(opened):
    actions.focus_result(opened)
    arrive(opened)
    assert_allclose(opened.state.view.target, opened.state.extent.centre)


def test_training_cameras_wrap_round(opened):
    actions.step_camera(opened, -1)
    arrive(opened)
    last = opened.state.scene.cameras[-1]
    assert opened.state.camera_index == 2
    assert_allclose(opened.state.view.camera(160, 120).world_to_camera, last.world_to_camera, atol=1e-9)
    actions.step_camera(opened, 1)
    assert opened.state.camera_index == 0


def test_a_scene_without_cameras_says_so(viewer):
    actions.open_scene(viewer, Path("bare.ply"))
    settle(viewer)
    actions.step_camera(viewer, 1)
    assert "no training cameras" in errors(viewer)[0]


def test_double_click_turns_around_the_surface(opened):
    actions.focus_pixel(opened, 0.75, 0.5)
    arrive(opened)
    assert_allclose(opened.state.view.target, (0.25, 0.0, 0.0))
    actions.focus_pixel(opened, 0.95, 0.5)
    assert "nothing under the cursor" in opened.state.messages[-1].text


def test_the_hand_stops_a_glide(opened):
    actions.reset_view(opened)
    actions.tick(opened, opened.clock + 0.3 * GLIDE_SECONDS)
    here = opened.state.view
    actions.move(opened, lambda view: view)
    assert opened.state.glide is None
    actions.tick(opened, opened.clock + 9)
    assert opened.state.view is here


def test_camera_actions_before_a_scene_is_open_do_nothing(viewer):
    for act in (actions.reset_view, actions.focus_result):
        act(viewer)
    actions.go_to_camera(viewer, 0)
    actions.focus_pixel(viewer, 0.5, 0.5)
    actions.move(viewer, lambda view: pytest.fail("there is no view to move"))
    assert viewer.state.view is None


# --- Files


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


def test_an_unwritable_folder_is_one_line(opened, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    assert saving.save_picture(opened, blocked) is None
    assert saving.save_view(opened, blocked) is None
    assert len(errors(opened)) == 2
    assert all("not saved" in text for text in errors(opened))


def test_nothing_to_save_before_a_scene_is_open(viewer, tmp_path):
    assert saving.save_picture(viewer, tmp_path) is None
    assert saving.save_view(viewer, tmp_path) is None
    assert len(errors(viewer)) == 2


def test_messages_do_not_grow_without_end(viewer):
    for number in range(3 * MAX_MESSAGES):
        viewer.state.say(f"message {number}")
    viewer.state.say(f"message {3 * MAX_MESSAGES - 1}")  # repeated: once is enough
    assert len(viewer.state.messages) == MAX_MESSAGES
    assert viewer.state.messages[-1].text == f"message {3 * MAX_MESSAGES - 1}"
    assert viewer.state.messages[-2].text != viewer.state.messages[-1].text


def test_worker_delivers_in_order_and_names_user_errors_plainly(viewer):
    seen = []

    def fail(progress):
        raise InputError("two\n lines")

    viewer.worker.submit("a", lambda progress: 1, seen.append, seen.append)
    viewer.worker.submit("b", fail, seen.append, seen.append)
    viewer.worker.submit("c", lambda progress: progress("half", 0.5) or 3, seen.append, seen.append)
    settle(viewer)
    assert seen == [1, "two lines", 3]
