"""transforms.json: poses, intrinsics in all their spellings, points, and what may be missing."""

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData, PlyElement

from langsplat_core.arrays import Array
from langsplat_core.config import DatasetConfig
from langsplat_core.datasets import load_capture
from langsplat_core.datasets.intrinsics import BrownDistortion, FisheyeDistortion, PhotoIntrinsics
from langsplat_core.datasets.nerfstudio import load_nerfstudio
from langsplat_core.errors import FormatError, InputError
from langsplat_core.progress import silent
from tests.support.photographed import pinhole_picture, poses, psnr, write_photos

pytestmark = pytest.mark.long

FOX = Path(__file__).parents[3] / "shared" / "data" / "fox"
LENS = PhotoIntrinsics(160, 120, 150.0, 148.0, 83.0, 58.0, BrownDistortion(-0.1, 0.02, 0.001, -0.001))
GLOBAL = {
    "w": 160, "h": 120, "fl_x": 150.0, "fl_y": 148.0, "cx": 83.0, "cy": 58.0,
    "k1": -0.1, "k2": 0.02, "p1": 0.001, "p2": -0.001,
}  # fmt: skip


def opengl_pose(world_to_camera: Array) -> list[list[float]]:
    """Camera-to-world with y up and z backwards, spelled out column by column."""
    rotation, translation = world_to_camera[:3, :3], world_to_camera[:3, 3]
    right, down, forward = rotation
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, -down, -forward, -rotation.T @ translation], axis=1)
    return matrix.tolist()


def write_dataset(
    folder: Path, top: dict[str, Any], intrinsics: PhotoIntrinsics = LENS, views: int = 3
) -> dict[str, Any]:
    matrices = poses(views)
    names = write_photos(folder / "images", intrinsics, matrices)
    frames = [
        {"file_path": f"./images/{name}", "transform_matrix": opengl_pose(matrix)}
        for name, matrix in zip(names, matrices, strict=True)
    ]
    data = {**top, "frames": frames}
    rewrite(folder, data)
    return data


def rewrite(folder: Path, data: object) -> Path:
    (folder / "transforms.json").write_text(json.dumps(data))
    return folder / "transforms.json"


def load(folder: Path):  # type: ignore[no-untyped-def]
    return load_nerfstudio(folder / "transforms.json", 160, silent)


def test_pictures_are_what_the_cameras_see(tmp_path: Path) -> None:
    write_dataset(tmp_path, GLOBAL)
    capture = load(tmp_path)
    assert [camera.name for camera in capture.cameras] == ["view_0", "view_1", "view_2"]
    for camera, image, matrix in zip(capture.cameras, capture.images, poses(3), strict=True):
        np.testing.assert_allclose(camera.world_to_camera, matrix, atol=1e-9)
        assert psnr(image, pinhole_picture(camera, 3)) > 33  # 26 when half a pixel off


def test_a_fisheye_lens(tmp_path: Path) -> None:
    intrinsics = PhotoIntrinsics(160, 120, 120.0, 120.0, 80.0, 60.0, FisheyeDistortion(0.02, -0.01))
    top = {"w": 160, "h": 120, "fl_x": 120.0, "fl_y": 120.0, "cx": 80.0, "cy": 60.0, "k1": 0.02, "k2": -0.01}
    write_dataset(tmp_path, {**top, "camera_model": "OPENCV_FISHEYE"}, intrinsics)
    capture = load(tmp_path)
    assert psnr(capture.images[1], pinhole_picture(capture.cameras[1], 3)) > 33


def test_intrinsics_from_the_field_of_view_and_the_file(tmp_path: Path) -> None:
    intrinsics = PhotoIntrinsics(160, 120, 140.0, 140.0, 80.0, 60.0)
    write_dataset(tmp_path, {"camera_angle_x": 2 * np.arctan(80 / 140.0)}, intrinsics)
    camera = load(tmp_path).cameras[0]
    assert (camera.width, camera.height) == (160, 120)
    np.testing.assert_allclose((camera.fx, camera.fy, camera.cx, camera.cy), (140, 140, 80, 60))


def test_a_frame_may_have_its_own_intrinsics(tmp_path: Path) -> None:
    data = write_dataset(tmp_path, {"w": 160, "h": 120, "fl_x": 140.0, "cx": 80.0, "cy": 60.0})
    data["frames"][1].update(fl_x=111.0, fl_y=112.0, cx=70.0)
    rewrite(tmp_path, data)
    first, second, _ = load(tmp_path).cameras
    assert (first.fx, first.fy, first.cx) == (140, 140, 80)
    assert (second.fx, second.fy, second.cx) == (111, 112, 70)


def test_paths_without_suffix_and_with_backslashes(tmp_path: Path) -> None:
    data = write_dataset(tmp_path, GLOBAL)
    data["frames"][0]["file_path"] = "images/view_0"
    data["frames"][1]["file_path"] = "images\\view_1.png"
    rewrite(tmp_path, data)
    assert len(load(tmp_path)) == 3


def test_missing_photographs_are_reported_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_dataset(tmp_path, GLOBAL)
    (tmp_path / "images/view_1.png").unlink()
    (tmp_path / "images/view_2.png").write_bytes(b"")
    with caplog.at_level(logging.WARNING, "langsplat"):
        capture = load(tmp_path)
    assert [camera.name for camera in capture.cameras] == ["view_0"]
    (record,) = caplog.records
    assert record.getMessage().startswith("2 of 3 photographs in transforms.json")
    assert "view_1.png" in record.getMessage()


def write_ply(path: Path, columns: dict[str, Array]) -> None:
    rows = np.zeros(len(columns["x"]), [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    PlyData([PlyElement.describe(rows, "vertex")]).write(path)


def test_points_stay_in_the_cameras_world(tmp_path: Path) -> None:
    """An applied_transform is already in poses and points, so it must change neither."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 3)).astype(np.float32)
    points[7, 1] = np.nan
    colours = rng.integers(0, 256, (50, 3), dtype=np.uint8)
    write_ply(
        tmp_path / "cloud.ply",
        dict(zip(("x", "y", "z", "red", "green", "blue"), [*points.T, *colours.T], strict=True)),
    )
    transform = [[0, 1, 0, 3], [1, 0, 0, 2], [0, 0, -1, 1]]
    write_dataset(tmp_path, {**GLOBAL, "ply_file_path": "cloud.ply", "applied_transform": transform})
    capture = load_capture(tmp_path / "transforms.json", DatasetConfig(max_side=160), tmp_path / "work")
    good = np.delete(np.arange(50), 7)
    np.testing.assert_array_equal(capture.points, points[good])
    np.testing.assert_array_equal(capture.colours, colours[good])
    np.testing.assert_allclose(capture.cameras[0].world_to_camera, poses(3)[0], atol=1e-9)


def test_points_that_are_not_there_are_named_in_short(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_dataset(tmp_path, {**GLOBAL, "ply_file_path": "a" * 2000 + ".ply"})
    with caplog.at_level(logging.WARNING, "langsplat"):
        assert len(load(tmp_path).points) == 0
    (said,) = (record.getMessage() for record in caplog.records if "do not exist" in record.getMessage())
    assert "aaa" in said
    assert len(said) < 300


def test_colours_may_be_fractions_or_absent(tmp_path: Path) -> None:
    write_dataset(tmp_path, {**GLOBAL, "ply_file_path": "cloud.ply"})
    xyz = {axis: np.ones(2, np.float64) for axis in "xyz"}
    write_ply(tmp_path / "cloud.ply", xyz | {c: np.array([0, 1], "f4") for c in ("red", "green", "blue")})
    np.testing.assert_array_equal(load(tmp_path).colours, [[0, 0, 0], [255, 255, 255]])
    write_ply(tmp_path / "cloud.ply", xyz)
    np.testing.assert_array_equal(load(tmp_path).colours, np.full((2, 3), 128))


def test_transparent_photographs_lie_over_black(tmp_path: Path) -> None:
    intrinsics = PhotoIntrinsics(160, 120, 140.0, 140.0, 80.0, 60.0)
    write_dataset(tmp_path, {"fl_x": 140.0}, intrinsics)
    pixels = np.full((120, 160, 4), 200, np.uint8)
    pixels[..., 3] = 255
    pixels[:60, :, 3] = 0
    pixels[60, :, 3] = 51
    Image.fromarray(pixels).save(tmp_path / "images/view_0.png")
    image = load(tmp_path).images[0]
    assert (image[:60] == 0).all()
    assert (image[60] == 40).all()
    assert (image[61:] == 200).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"transform_matrix": [[1, 2], [3, 4]]}, "transform_matrix"),
        ({"transform_matrix": None}, "transform_matrix"),
        ({"transform_matrix": [["a"] * 4] * 4}, "transform_matrix"),
        ({"transform_matrix": np.diag([2.0, 2, 2, 1]).tolist()}, "rotation"),
        ({"transform_matrix": np.diag([1.0, 1, -1, 1]).tolist()}, "rotation"),
        ({"transform_matrix": np.full((4, 4), np.nan).tolist()}, "transform_matrix"),
        ({"transform_matrix": [[10**400] * 4] * 4}, "transform_matrix"),
        ({"transform_matrix": [[1, 0, 0, 1e300], [0, 1, 0, 0], [0, 0, 1, 0]]}, "transform_matrix"),
        ({"fl_x": "wide"}, "fl_x"),
        ({"fl_x": 1e-9}, "none has such a lens"),
        ({"fl_x": 1e14}, "none has such a lens"),
        ({"cx": 1e14}, "far outside"),
        ({"w": 1e9, "h": 1e9}, "pixels a side"),
        ({"fl_x": -3}, "focal"),
        ({"fl_x": float("inf")}, "fl_x"),
        ({"w": 0}, "pixels"),
        ({"cx": None}, "cx"),
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR"),
        ({"k4": 0.1}, "k4"),
        ({"file_path": 3}, "file_path"),
    ],
)
def test_a_broken_frame_is_named(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    data = write_dataset(tmp_path, GLOBAL)
    data["frames"][1].update(change)
    rewrite(tmp_path, data)
    with pytest.raises(FormatError, match=words) as caught:
        load(tmp_path)
    assert "frame 1" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_neither_focal_length_nor_angle(tmp_path: Path) -> None:
    write_dataset(tmp_path, {})
    with pytest.raises(FormatError, match=r"fl_x.*camera_angle_x"):
        load(tmp_path)


@pytest.mark.skipif(not FOX.is_dir(), reason="real data absent")
def test_the_real_dataset_with_missing_files(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "langsplat"):
        capture = load_nerfstudio(FOX / "transforms.json", 128, silent)
    assert len(capture) == 50
    assert "17 of 67" in caplog.text
    assert {max(image.shape) for image in capture.images} == {128}
    assert all(image.mean() > 30 for image in capture.images)


def test_a_dataset_may_say_how_long_its_unit_is_and_that_it_is_drawn(tmp_path: Path) -> None:
    data = write_dataset(tmp_path, GLOBAL)
    assert load(tmp_path).metres_per_unit is None
    rewrite(tmp_path, {**data, "metres_per_unit": 0.5})
    assert load(tmp_path).metres_per_unit == 0.5
    (tmp_path / "work").mkdir()
    assert not load(tmp_path).drawn
    for said in (True, "yes"):
        rewrite(tmp_path, {**data, "drawn": said})
        assert load(tmp_path).drawn == (said is True)
    rewrite(tmp_path, {**data, "metres_per_unit": 0.5})
    given = load_capture(tmp_path, DatasetConfig(metres_per_unit=2.0), tmp_path / "work")
    assert given.metres_per_unit == 2.0
    for wrong in (0, -1, "1 m", [1]):
        rewrite(tmp_path, {**data, "metres_per_unit": wrong})
        with pytest.raises(FormatError, match="metres_per_unit"):
            load(tmp_path)
    with pytest.raises(InputError, match=r"--dataset\.metres-per-unit 0: must be above 0"):
        load_capture(tmp_path, DatasetConfig(metres_per_unit=0.0), tmp_path / "work")
