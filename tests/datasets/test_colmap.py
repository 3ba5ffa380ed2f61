"""COLMAP models: read as COLMAP reads them, and turned into pinhole captures."""

import logging
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from langsplat_core.config import DatasetConfig
from langsplat_core.datasets import load_capture
from langsplat_core.datasets.colmap import find_model, good_points, read_model
from langsplat_core.datasets.intrinsics import BrownDistortion, PhotoIntrinsics
from langsplat_core.errors import InputError
from tests.support.photographed import (
    colmap_reconstruction,
    photograph,
    pinhole_picture,
    poses,
    psnr,
    write_photos,
)

pytestmark = pytest.mark.long

BANANA = Path(__file__).parents[3] / "shared" / "data" / "banana" / "colmap_640"
PARAMS = [190.0, 188.0, 103.0, 74.0, -0.1, 0.02, 0.001, -0.001]
LENS = PhotoIntrinsics(200, 150, *PARAMS[:4], BrownDistortion(*PARAMS[4:]))
WHOLE = DatasetConfig(max_side=200)


def write_dataset(folder: Path, form: str = "bin", subfolder: str = "sparse/0", views: int = 3) -> None:
    """Photographs of the room through an OPENCV lens, and a model with ten points on its floor."""
    matrices = poses(views)
    names = write_photos(folder / "images", LENS, matrices)
    # Listed backwards: the order of the file must not matter.
    model = colmap_reconstruction("OPENCV", (200, 150), PARAMS, names[::-1], matrices[::-1])
    track = pycolmap.Track()
    for index in range(10):
        model.add_point3D(np.array([3.0, 0.2 * index + 1.5, 0.0]), track, np.array([index, 2, 3], np.uint8))
    out = folder / subfolder
    out.mkdir(parents=True)
    (model.write_binary if form == "bin" else model.write_text)(out)


@pytest.mark.parametrize("form", ["bin", "txt"])
def test_a_model_reads_as_pycolmap_reads_it(tmp_path: Path, form: str) -> None:
    write_dataset(tmp_path, form)
    ours, theirs = read_model(tmp_path / "sparse/0"), pycolmap.Reconstruction(tmp_path / "sparse/0")
    assert {image.name for image in ours.images} == {image.name for image in theirs.images.values()}
    for image in ours.images:
        want = theirs.find_image_with_name(image.name).cam_from_world().matrix()
        np.testing.assert_allclose(image.world_to_camera[:3], want, atol=1e-12)
    camera = ours.cameras[1]
    assert (camera.model, camera.width, camera.height) == ("OPENCV", 200, 150)
    assert camera.params == pytest.approx(PARAMS)
    points = [theirs.points3D[key] for key in sorted(theirs.points3D)]
    np.testing.assert_allclose(ours.points, [p.xyz for p in points])
    np.testing.assert_array_equal(ours.colours, [p.color for p in points])


@pytest.mark.skipif(not BANANA.is_dir(), reason="real data absent")
@pytest.mark.parametrize("folder", ["sparse", "sparse_text"])
def test_a_real_model_reads_as_pycolmap_reads_it(folder: str) -> None:
    ours, theirs = read_model(BANANA / folder), pycolmap.Reconstruction(BANANA / folder)
    points = [theirs.points3D[key] for key in sorted(theirs.points3D)]
    order = np.lexsort(ours.points.T)
    want = np.array([p.xyz for p in points])
    np.testing.assert_allclose(ours.points[order], want[np.lexsort(want.T)], rtol=1e-9)
    assert sorted(ours.track_lengths) == sorted(p.track.length() for p in points)
    assert ours.errors.mean() == pytest.approx(np.mean([p.error for p in points]))
    for image in ours.images:
        pose = theirs.find_image_with_name(image.name).cam_from_world().matrix()
        np.testing.assert_allclose(image.world_to_camera[:3], pose, atol=1e-9)


@pytest.mark.parametrize(("form", "subfolder"), [("bin", "sparse/0"), ("txt", "sparse")])
def test_a_capture_shows_what_its_cameras_see(tmp_path: Path, form: str, subfolder: str) -> None:
    write_dataset(tmp_path, form, subfolder)
    labels: list[str] = []
    capture = load_capture(tmp_path, WHOLE, tmp_path / "work", lambda label, _: labels.append(label))
    assert [camera.name for camera in capture.cameras] == ["view_0", "view_1", "view_2"]
    for camera, image, matrix in zip(capture.cameras, capture.images, poses(3), strict=True):
        np.testing.assert_allclose(camera.world_to_camera, matrix, atol=1e-12)
        assert psnr(image, pinhole_picture(camera, 3)) > 35  # 28 when half a pixel off
    assert capture.points.shape == (10, 3)
    assert set(labels) == {"reading photographs"}
    assert not (tmp_path / "work").exists()  # nothing had to be computed


def test_of_several_models_the_one_with_most_photographs_is_taken(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for name, views in (("0", 2), ("1", 4), ("2", 4), ("10", 3)):
        write_dataset(tmp_path, subfolder=f"sparse/{name}", views=views)
    (tmp_path / "sparse/other").mkdir()
    with caplog.at_level(logging.WARNING, "langsplat"):
        assert len(load_capture(tmp_path, WHOLE, tmp_path / "work")) == 4
    (said,) = [record.getMessage() for record in caplog.records if "models" in record.getMessage()]
    assert "4 models; 1 is taken, which has most photographs (0: 2, 1: 4, 2: 4, 10: 3)" in said

    images = tmp_path / "sparse/1/images.bin"
    images.write_bytes(images.read_bytes()[:100])
    assert find_model(tmp_path) == tmp_path / "sparse/2"
    for path in tmp_path.glob("sparse/*/images.bin"):
        path.write_bytes(b"\xff" * 20)
    with pytest.raises(InputError, match=r"sparse/0/images\.bin is no readable COLMAP file"):
        load_capture(tmp_path, WHOLE, tmp_path / "work")


def test_photographs_in_subfolders_keep_apart(tmp_path: Path) -> None:
    matrices = poses(2)
    names = ["left/0001.png", "right/0001.png"]
    for name, matrix in zip(names, matrices, strict=True):
        (tmp_path / "images" / name).parent.mkdir(parents=True)
        Image.fromarray(photograph(LENS, matrix)).save(tmp_path / "images" / name)
    model = colmap_reconstruction("OPENCV", (200, 150), PARAMS, names, matrices)
    model.add_point3D(np.zeros(3), pycolmap.Track(), np.zeros(3, np.uint8))
    (tmp_path / "sparse").mkdir()
    model.write_text(tmp_path / "sparse")
    capture = load_capture(tmp_path, WHOLE, tmp_path / "work")
    assert [camera.name for camera in capture.cameras] == ["left_0001", "right_0001"]


def test_missing_photographs_are_reported_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_dataset(tmp_path)
    (tmp_path / "images/view_1.png").unlink()
    with caplog.at_level(logging.WARNING, "langsplat"):
        capture = load_capture(tmp_path, WHOLE, tmp_path / "work")
    assert [camera.name for camera in capture.cameras] == ["view_0", "view_2"]
    assert [r.getMessage() for r in caplog.records] == [
        "1 of 3 photographs of the model do not exist and are left out: view_1.png"
    ]


def test_a_model_of_few_of_the_photographs_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_dataset(tmp_path)
    for index in range(4):
        Image.new("RGB", (8, 8)).save(tmp_path / "images" / f"other_{index}.png")
    with caplog.at_level(logging.WARNING, "langsplat"):
        assert len(load_capture(tmp_path, WHOLE, tmp_path / "work")) == 3
    (message,) = [record.getMessage() for record in caplog.records]
    assert "cameras for only 3 of the 7 photographs" in message


def test_no_photograph_at_all_is_an_error(tmp_path: Path) -> None:
    write_dataset(tmp_path)
    for photo in (tmp_path / "images").iterdir():
        photo.unlink()
    with pytest.raises(InputError, match=r"none of its 3 photographs .*view_.*png"):
        load_capture(tmp_path, WHOLE, tmp_path / "work")


def test_photographs_shrunk_by_the_user_still_fit(tmp_path: Path) -> None:
    write_dataset(tmp_path)
    for photo in (tmp_path / "images").iterdir():
        Image.open(photo).reduce(2).save(photo)
    capture = load_capture(tmp_path, WHOLE, tmp_path / "work")
    assert capture.cameras[0].width <= 110
    assert psnr(capture.images[0], pinhole_picture(capture.cameras[0], 4)) > 30


def test_photographs_of_another_shape_are_refused(tmp_path: Path) -> None:
    write_dataset(tmp_path)
    photo = tmp_path / "images/view_1.png"
    Image.open(photo).crop((0, 0, 150, 150)).save(photo)
    with pytest.raises(InputError, match=r"view_1\.png is 150x150 pixels but its camera is 200x150"):
        load_capture(tmp_path, WHOLE, tmp_path / "work")


@pytest.mark.parametrize(("tag", "turn"), [(6, Image.Transpose.ROTATE_90), (8, Image.Transpose.ROTATE_270)])
def test_a_turned_photograph_is_turned_back_when_its_camera_is_upright(
    tmp_path: Path, tag: int, turn: Image.Transpose
) -> None:
    write_dataset(tmp_path)
    want = load_capture(tmp_path, WHOLE, tmp_path / "work")
    exif = Image.Exif()
    exif[0x0112] = tag
    photo = tmp_path / "images/view_1.png"
    Image.open(photo).transpose(turn).save(photo, exif=exif)
    got = load_capture(tmp_path, WHOLE, tmp_path / "work")
    np.testing.assert_array_equal(got.images[1], want.images[1])


def test_plainly_wrong_points_are_dropped(tmp_path: Path) -> None:
    write_dataset(tmp_path, "txt")
    rows = [
        "1 1 2 3 9 8 7 0.5 1 1 2 2",  # seen twice: kept
        "2 1 2 3 9 8 7 0.5 1 1",  # seen once
        "3 1 2 3 9 8 7 4.5 1 1 2 2 3 3",  # too far off
        "4 nan 2 3 9 8 7 0.5 1 1 2 2",
        "5 1 2 3 9 8 7 -1",  # no track, error unknown: a cloud from elsewhere, kept
    ]
    (tmp_path / "sparse/0/points3D.txt").write_text("\n".join(rows))
    points, colours = good_points(read_model(tmp_path / "sparse/0"))
    np.testing.assert_array_equal(points, [[1, 2, 3], [1, 2, 3]])
    np.testing.assert_array_equal(colours, [[9, 8, 7], [9, 8, 7]])


@pytest.mark.skipif(not BANANA.is_dir(), reason="real data absent")
def test_real_points_lie_where_the_photographs_show_them(tmp_path: Path) -> None:
    capture = load_capture(BANANA, DatasetConfig(max_side=320), tmp_path)
    assert len(capture) == 14
    assert len(capture.points) == 7308
    camera, image = capture.cameras[7], capture.images[7].astype(float)
    pixels, depth = camera.project(capture.points)
    seen = (depth > 0) & (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1)
    x, y = pixels[seen].astype(int).T
    off = np.abs(image[y, x] - capture.colours[seen]).mean(1)
    shuffled = np.abs(image[y, x] - capture.colours[seen][::-1]).mean(1)
    assert np.median(off) < 0.7 * np.median(shuffled)
