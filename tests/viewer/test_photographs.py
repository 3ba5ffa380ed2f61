"""The photograph of a training camera, without a window."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from langsplat_core.errors import InputError
from langsplat_viewer.actions import opening, viewpoint
from langsplat_viewer.files.photographs import LONGEST_SIDE, corners, find, read
from langsplat_viewer.files.preferences import (
    MOST_FOLDERS,
    Preferences,
    load_preferences,
    save_preferences,
    with_photographs,
)
from tests.support.fakes import cameras
from tests.support.windowless import SCENES, arrive, settle

CAMERA = cameras()[0]  # of 160 x 120 pixels


def photograph(path: Path, size=(160, 120), **options) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, (200, 100, 50)).save(path, **options)
    return path


@pytest.mark.parametrize("place", ["scene/images", "scene", "images", "."])
def test_it_is_found_where_photographs_usually_lie(tmp_path, place):
    wanted = photograph(tmp_path / place / "photo_0.JPG")
    photograph(tmp_path / place / "photo_01.jpg")
    assert find("photo_0", tmp_path / "scene.ply", "") == wanted


@pytest.mark.parametrize("name", ["b", "left/b", "left_b"])
def test_it_is_found_in_a_chosen_folder_and_those_in_it(tmp_path, name):
    wanted = photograph(tmp_path / "photos" / "left" / "b.png")
    photograph(tmp_path / "b.png")  # where it would be without a choice
    assert find(name, tmp_path / "scene.ply", str(tmp_path / "photos")) == wanted


@pytest.mark.parametrize("folder", ["", "away", "file.txt"])
def test_where_there_is_none_the_reason_says_where_it_was_looked_for(tmp_path, folder):
    (tmp_path / "file.txt").write_text("b")
    (tmp_path / "b.txt").write_text("no photograph")
    chosen = str(tmp_path / folder) if folder else ""
    with pytest.raises(InputError, match="no photograph 'b' in ") as caught:
        find("b", tmp_path / "scene.ply", chosen)
    assert str(tmp_path) in str(caught.value)
    with pytest.raises(InputError, match="does not name"):
        find("", tmp_path / "scene.ply", chosen)


def test_a_large_one_is_shrunk(tmp_path):
    image = read(photograph(tmp_path / "a.jpg", (4000, 3000)), CAMERA)
    assert image.shape == (LONGEST_SIDE * 3 // 4, LONGEST_SIDE, 3)
    np.testing.assert_allclose(image.mean((0, 1)), (200, 100, 50), atol=2)


def test_one_that_lies_on_its_side_is_turned(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    assert read(photograph(tmp_path / "a.jpg", (120, 160), exif=exif), CAMERA).shape == (120, 160, 3)
    kept = replace(CAMERA, width=120, height=160)
    assert read(tmp_path / "a.jpg", kept).shape == (160, 120, 3)  # it fits as it is


@pytest.mark.parametrize("mode", ["L", "RGBA", "P", "I;16"])
def test_every_kind_of_pixel_becomes_three_bytes(tmp_path, mode):
    pixels = np.full((120, 160), 200, np.uint8)
    picture = (
        Image.fromarray(pixels).convert(mode)
        if mode != "I;16"
        else Image.fromarray(np.full((120, 160), 200 * 256, np.uint16))
    )
    picture.save(tmp_path / "a.png")
    image = read(tmp_path / "a.png", CAMERA)
    assert (image.shape, image.dtype) == ((120, 160, 3), np.uint8)
    np.testing.assert_allclose(image, 200, atol=1)


def test_one_of_another_shape_is_refused(tmp_path):
    with pytest.raises(InputError, match="100x100 pixels, its camera 160x120"):
        read(photograph(tmp_path / "a.png", (100, 100)), CAMERA)
    (tmp_path / "b.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match=r"b\.png"):
        read(tmp_path / "b.png", CAMERA)


def test_it_lies_where_its_camera_saw_it(opened):
    viewpoint.go_to_camera(opened, 1)
    arrive(opened)
    camera = opened.state.scene.cameras[1]
    shown = opened.state.view.camera(500, 300)
    left, top, right, bottom = corners(camera, shown)
    point = np.array([[0.3, 0.2, 0.1]])
    (there,), _ = camera.project(point)
    (here,), _ = shown.project(point)
    place = (left + there[0] * (right - left) / 160, top + there[1] * (bottom - top) / 120)
    np.testing.assert_allclose(place, here, atol=1e-6)
    assert bottom - top == pytest.approx(300)


@pytest.fixture
def beside_photograph(opened, tmp_path):
    """A scene that lies beside the photograph of its second camera."""
    opened.state.path = tmp_path / "blobs.ply"
    photograph(tmp_path / "images" / "photo_1.png")
    return opened


def stand(viewer, index: int) -> None:
    viewpoint.go_to_camera(viewer, index)
    arrive(viewer)
    opening.fetch_photograph(viewer)
    settle(viewer)


def test_it_is_read_once_it_is_wanted_and_only_at_its_camera(beside_photograph):
    stand(beside_photograph, 1)
    assert beside_photograph.state.photograph is None
    opening.fade_photograph(beside_photograph, 3.0)
    assert beside_photograph.state.seeing.fade == 1
    stand(beside_photograph, 1)
    found = opening.photograph_here(beside_photograph.state)
    assert found.image.shape == (120, 160, 3)
    stand(beside_photograph, 1)
    assert opening.photograph_here(beside_photograph.state) is found  # not read again
    viewpoint.zoom_by(beside_photograph, 1.1)
    assert opening.photograph_here(beside_photograph.state) is None
    stand(beside_photograph, 2)
    here = opening.photograph_here(beside_photograph.state)
    assert here.image is None
    assert "no photograph 'photo_2'" in here.reason


def test_a_chosen_folder_is_looked_into_and_remembered(beside_photograph, tmp_path):
    photograph(tmp_path / "away" / "deep" / "photo_2.jpg")
    opening.fade_photograph(beside_photograph, 1.0)
    stand(beside_photograph, 2)
    opening.ask_for_photographs(beside_photograph)
    assert beside_photograph.state.picks_folder
    opening.choose_photograph_folder(beside_photograph, tmp_path / "away")
    assert beside_photograph.state.browser is None
    stand(beside_photograph, 2)
    assert opening.photograph_here(beside_photograph.state).image.shape == (120, 160, 3)
    save_preferences(tmp_path / "settings", beside_photograph.state.preferences)
    assert load_preferences(tmp_path / "settings").photographs == {
        str(tmp_path / "blobs.ply"): str(tmp_path / "away")
    }
    opening.ask_for_file(beside_photograph)
    assert not beside_photograph.state.picks_folder


def test_folders_are_not_remembered_without_end():
    preferences = Preferences()
    for number in (*range(MOST_FOLDERS + 3), 5):
        preferences = with_photographs(preferences, Path(f"/{number}.ply"), Path("/photos"))
    assert len(preferences.photographs) == MOST_FOLDERS
    assert list(preferences.photographs)[-2:] == [f"/{MOST_FOLDERS + 2}.ply", "/5.ply"]


def test_without_cameras_there_is_no_photograph(viewer):
    opening.open_scene(viewer, Path("bare.ply"))
    settle(viewer)
    opening.fade_photograph(viewer, 1.0)
    opening.fetch_photograph(viewer)
    assert viewer.state.photograph is None
    assert viewer.state.scene is SCENES["bare.ply"]
