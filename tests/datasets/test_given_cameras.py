"""Datasets that bring cameras, COLMAP's and nerfstudio's, also hostile ones; lenses and their pictures."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from PIL import Image
from plyfile import PlyData, PlyElement

from langsplat_core.arrays import Array
from langsplat_core.config import DatasetConfig
from langsplat_core.datasets import Capture, load_capture, load_photographs
from langsplat_core.datasets.capture import split_views
from langsplat_core.datasets.colmap import LENSES, find_model, good_points, lens_of, read_model
from langsplat_core.datasets.intrinsics import (
    BrownDistortion,
    FisheyeDistortion,
    PhotoIntrinsics,
    pinhole_for,
    resample,
    source_positions,
    undistorted_points,
)
from langsplat_core.datasets.nerfstudio import DISTORTING, load_nerfstudio
from langsplat_core.errors import FormatError, InputError
from langsplat_core.progress import Progress, silent
from langsplat_core.scene import NO_ORIGIN, moved_pose
from tests.support.file_samples import same_or_a_line
from tests.support.photographs import (
    CONFIG,
    lens_params,
    photograph,
    pinhole_picture,
    poses,
    psnr,
    refuse,
    write_colmap,
    write_model,
    write_nerfstudio,
    write_photos,
)

pytestmark = pytest.mark.long

CURVE = BrownDistortion(-0.1, 0.02, 0.001, -0.001)
LENS = PhotoIntrinsics(200, 150, 190.0, 188.0, 103.0, 74.0, CURVE)
SMALL_LENS = PhotoIntrinsics(40, 30, 38.0, 37.6, 20.6, 14.8, CURVE)
WHOLE = DatasetConfig(max_side=200)
FLOOR = np.array([[3.0, 0.2 * index + 1.5, 0.0] for index in range(10)])  # points on it


def write_dataset(
    folder: Path, form: str = "bin", subfolder: str = "sparse/0", views: int = 3, at: Array = NO_ORIGIN
) -> None:
    """Photographs of the room, whose zero is `at`, by an OPENCV lens; a model with points on its floor."""
    matrices = poses(views)
    names = write_photos(folder / "images", LENS, matrices)
    # Listed backwards: the order of the file must not matter.
    matrices = [moved_pose(matrix, at) for matrix in matrices[::-1]]
    write_model(folder / subfolder, LENS, names[::-1], matrices, FLOOR + at, form)


@pytest.mark.parametrize("form", ["bin", "txt"])
def test_a_model_reads_as_pycolmap_reads_it(tmp_path: Path, form: str) -> None:
    write_dataset(tmp_path, form)
    ours, theirs = read_model(tmp_path / "sparse/0"), pycolmap.Reconstruction(tmp_path / "sparse/0")
    assert {image.name for image in ours.images} == {image.name for image in theirs.images.values()}
    for image in ours.images:
        want = theirs.find_image_with_name(image.name).cam_from_world().matrix()
        np.testing.assert_allclose(image.world_to_camera[:3], want, atol=1e-12)
    assert ours.lenses == {1: LENS}
    points = [theirs.points3D[key] for key in sorted(theirs.points3D)]
    np.testing.assert_allclose(ours.points["position"], [p.xyz for p in points])
    np.testing.assert_array_equal(ours.points["colour"], [p.color for p in points])


PLACES = {"zero": (0.0, 0.0, 0.0), "UTM": (500_123.25, 5_412_345.5, 0.0), "ECEF": (4.0e6, 7.0e5, 4.9e6)}


@pytest.mark.parametrize("at", PLACES)
@pytest.mark.parametrize("form", ["bin", "txt", "json"])
def test_a_capture_shows_what_its_cameras_see_at_any_place(tmp_path: Path, form: str, at: str) -> None:
    place = np.array(PLACES[at])
    if form == "txt":
        write_dataset(tmp_path, form, "sparse", at=place)
    else:
        write_dataset(tmp_path, at=place)
    if form == "json":  # the same photographs as nerfstudio lists them
        points = read_model(tmp_path / "sparse/0").points["position"]
        write_ply(tmp_path / "points.ply", *points.T)
        frames = frames_of([f"view_{index}.png" for index in range(3)], poses(3), place)
        rewrite(tmp_path, {**stated(LENS), "frames": frames, "ply_file_path": "points.ply"})
    labels: list[str] = []
    capture = load_capture(tmp_path, WHOLE, tmp_path / "work", Progress(lambda at: labels.append(at.stage)))
    assert set(labels) == {"reading photographs"}
    assert not (tmp_path / "work").exists()  # nothing had to be computed
    assert [camera.name for camera in capture.cameras] == ["view_0", "view_1", "view_2"]
    assert np.abs(capture.origin - place).max() < 20
    exact = 1e-8 if place.any() else 1e-9 if form == "json" else 1e-12
    for camera, image, matrix in zip(capture.cameras, capture.images, poses(3), strict=True):
        back = camera.moved(capture.origin - place)
        np.testing.assert_allclose(back.world_to_camera, matrix, atol=exact)
        assert psnr(image, pinhole_picture(back, 3)) > 35  # 28 when half a pixel off
    again = capture.read_at([0], 100)
    np.testing.assert_array_equal(again.cameras[0].world_to_camera, capture.cameras[0].world_to_camera)
    np.testing.assert_allclose(capture.points + (capture.origin - place), FLOOR, atol=1e-8)


def test_the_model_with_most_photographs_is_taken(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for name, views in (("0", 2), ("1", 4), ("2", 4), ("10", 3)):
        write_dataset(tmp_path, subfolder=f"sparse/{name}", views=views)
    (tmp_path / "sparse/other").mkdir()
    assert len(load_capture(tmp_path, WHOLE, tmp_path / "work")) == 4
    (said,) = [record.getMessage() for record in caplog.records if "models" in record.getMessage()]
    assert "4 models; 1 is taken" in said

    images = tmp_path / "sparse/1/images.bin"
    images.write_bytes(images.read_bytes()[:100])
    assert find_model(tmp_path) == tmp_path / "sparse/2"
    for path in tmp_path.glob("sparse/*/images.bin"):
        path.write_bytes(b"\xff" * 20)
    with pytest.raises(InputError, match=r"sparse/0/images\.bin is no readable COLMAP file"):
        load_capture(tmp_path, WHOLE, tmp_path / "work")


def test_missing_photographs_and_cameras_are_warned_of(tmp_path, caplog):
    write_dataset(tmp_path, subfolder=".")
    photos = tmp_path / "images"
    (photos / "view_1.png").unlink()
    capture = load_capture(tmp_path, WHOLE, tmp_path / "work")
    assert [camera.name for camera in capture.cameras] == ["view_0", "view_2"]
    assert caplog.messages == ["1 of 3 photographs of the model do not exist and are left out: view_1.png"]
    for index in range(4):
        Image.new("RGB", (8, 8)).save(photos / f"other_{index}.png")
    assert len(load_capture(tmp_path, WHOLE, tmp_path / "work")) == 2
    assert "cameras for only 2 of the 6 photographs" in caplog.messages[-1]
    for name in ("view_0.png", "view_2.png"):
        (photos / name).unlink()
    with pytest.raises(InputError, match=r"none of its 3 photographs .*view_.*png"):
        load_capture(tmp_path, WHOLE, tmp_path / "work")


def test_photographs_of_another_shape_are_refused(tmp_path: Path) -> None:
    write_dataset(tmp_path, subfolder="colmap/sparse/0")
    photo = tmp_path / "images/view_1.png"
    Image.open(photo).crop((0, 0, 150, 150)).save(photo)
    with pytest.raises(InputError, match=r"view_1\.png is 150x150 pixels but its camera is 200x150"):
        load_capture(tmp_path, WHOLE, tmp_path / "work")


@pytest.mark.parametrize(("tag", "turn"), [(6, Image.Transpose.ROTATE_90), (8, Image.Transpose.ROTATE_270)])
def test_photographs_are_turned_to_their_cameras(tmp_path: Path, tag: int, turn: Image.Transpose) -> None:
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


@pytest.mark.parametrize(("name", "left"), [("points3D.ply", None), ("points.ply", "")])
def test_points_of_a_ply_beside_the_model_are_used(tmp_path: Path, name: str, left: str | None) -> None:
    model = write_colmap(tmp_path, "txt")
    want = load_capture(tmp_path, CONFIG, tmp_path / "work")
    (model / "points3D.txt").unlink()
    if left is not None:
        (model / "points3D.txt").write_text(left)
    write_ply(model / name, *want.points.T, *want.colours.T)
    got = load_capture(tmp_path, CONFIG, tmp_path / "work")
    np.testing.assert_array_equal(got.points, want.points)
    np.testing.assert_array_equal(got.colours, want.colours)


# transforms.json: poses, intrinsics in all their spellings, points, and what may be missing.


def stated(lens: PhotoIntrinsics) -> dict[str, Any]:
    """The lens as a transforms.json states it."""
    keys = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")
    size = {"w": lens.width, "h": lens.height, "camera_model": "OPENCV"}
    return {**size, **dict(zip(keys, lens_params(lens), strict=True))}


NERFSTUDIO_LENS = PhotoIntrinsics(160, 120, 150.0, 148.0, 83.0, 58.0, CURVE)
GLOBAL = stated(NERFSTUDIO_LENS)


def frames_of(names: list[str], matrices: list[Array], at: Array = NO_ORIGIN) -> list[dict[str, Any]]:
    """Frames of the room that lies `at`: camera-to-world with y up and z backwards, column by column."""
    frames = []
    for name, matrix in zip(names, matrices, strict=True):
        rotation, translation = matrix[:3, :3], matrix[:3, 3]
        right, down, forward = rotation
        pose = np.eye(4)
        pose[:3] = np.stack([right, -down, -forward, at - rotation.T @ translation], axis=1)
        frames.append({"file_path": f"./images/{name}", "transform_matrix": pose.tolist()})
    return frames


def write_transforms(
    folder: Path, top: dict[str, Any], intrinsics: PhotoIntrinsics = NERFSTUDIO_LENS, views: int = 3
) -> dict[str, Any]:
    matrices = poses(views)
    names = write_photos(folder / "images", intrinsics, matrices)
    data = {**top, "frames": frames_of(names, matrices)}
    rewrite(folder, data)
    return data


def rewrite(folder: Path, data: object) -> Path:
    (folder / "transforms.json").write_text(json.dumps(data))
    return folder / "transforms.json"


def load(folder: Path):  # type: ignore[no-untyped-def]
    return load_nerfstudio(folder / "transforms.json", DatasetConfig(max_side=160), silent)


def test_intrinsics_from_the_field_of_view_and_the_file(tmp_path: Path) -> None:
    intrinsics = PhotoIntrinsics(160, 120, 140.0, 140.0, 80.0, 60.0)
    write_transforms(tmp_path, {"camera_angle_x": 2 * np.arctan(80 / 140.0)}, intrinsics)
    camera = load(tmp_path).cameras[0]
    assert (camera.width, camera.height) == (160, 120)
    np.testing.assert_allclose((camera.fx, camera.fy, camera.cx, camera.cy), (140, 140, 80, 60))


def test_a_frame_may_have_its_own_intrinsics(tmp_path: Path) -> None:
    data = write_transforms(tmp_path, {"w": 160, "h": 120, "cx": 80.0, "cy": 60.0})
    with pytest.raises(FormatError, match=r"fl_x.*camera_angle_x"):
        load(tmp_path)
    data["fl_x"] = 140.0
    data["frames"][1].update(fl_x=111.0, fl_y=112.0, cx=70.0)
    rewrite(tmp_path, data)
    first, second, _ = load(tmp_path).cameras
    assert (first.fx, first.fy, first.cx) == (140, 140, 80)
    assert (second.fx, second.fy, second.cx) == (111, 112, 70)


def test_paths_are_read_leniently_and_missing_frames_reported_once(tmp_path, caplog):
    data = write_transforms(tmp_path, GLOBAL)
    data["frames"][0]["file_path"] = "images/view_0"  # suffixes may be left away
    data["frames"][1]["file_path"] = "images\\view_1.png"
    rewrite(tmp_path, data)
    assert len(load(tmp_path)) == 3
    (tmp_path / "apart").mkdir()
    (tmp_path / "apart/transforms.json").symlink_to(tmp_path / "transforms.json")
    assert len(load(tmp_path / "apart")) == 3  # beside the link's target
    (tmp_path / "images/view_1.png").unlink()
    (tmp_path / "images/view_2.png").write_bytes(b"")
    assert [camera.name for camera in load(tmp_path).cameras] == ["view_0"]
    (record,) = caplog.records
    assert record.getMessage().startswith("2 of 3 photographs in transforms.json")
    assert "view_1.png" in record.getMessage()


def write_ply(path: Path, *columns: Array) -> None:
    """Of x, y, z and, where there are any, colours."""
    names = ["x", "y", "z", "red", "green", "blue"][: len(columns)]
    PlyData([PlyElement.describe(np.rec.fromarrays(columns, names=names), "vertex")]).write(path)


def test_applied_transform_changes_neither_points_nor_poses(tmp_path: Path) -> None:
    """An applied_transform is already in poses and points, so it must change neither."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 3)).astype(np.float32)
    points[7, 1] = np.nan
    colours = rng.integers(0, 256, (50, 3), dtype=np.uint8)
    write_ply(tmp_path / "cloud.ply", *points.T, *colours.T)
    transform = [[0, 1, 0, 3], [1, 0, 0, 2], [0, 0, -1, 1]]
    write_transforms(tmp_path, {**GLOBAL, "ply_file_path": "cloud.ply", "applied_transform": transform})
    capture = load_capture(tmp_path / "transforms.json", DatasetConfig(max_side=160), tmp_path / "work")
    good = np.delete(np.arange(50), 7)
    np.testing.assert_array_equal(capture.points, points[good])
    np.testing.assert_array_equal(capture.colours, colours[good])
    np.testing.assert_allclose(capture.cameras[0].world_to_camera, poses(3)[0], atol=1e-9)


def test_synthetic_scenes_of_nerf_hold_their_test_views_out(tmp_path: Path) -> None:
    data = write_transforms(tmp_path, GLOBAL, views=4)
    (tmp_path / "transforms.json").unlink()
    parts = {"train": data["frames"][:2], "test": data["frames"][2:3], "val": data["frames"][3:]}
    for part, frames in parts.items():
        text = json.dumps({**data, "frames": frames})
        (tmp_path / f"transforms_{part}.json").write_text(text)
    capture = load_photographs(tmp_path, WHOLE, tmp_path / "work")
    assert [camera.name for camera in capture.cameras] == ["view_0", "view_1", "view_2"]
    assert split_views(capture, WHOLE) == ([0, 1], [2])
    assert split_views(capture, replace(WHOLE, test_every=0)) == ([0, 1, 2], [])
    rewrite(tmp_path, {**data, "train_filenames": ["images/view_0.png", "images/view_3"]})
    assert split_views(load_photographs(tmp_path, WHOLE, tmp_path / "work"), WHOLE) == ([0, 3], [1, 2])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"transform_matrix": [[1, 2], [3, 4]]}, "transform_matrix"),
        ({"transform_matrix": np.diag([1.0, 1, -1, 1]).tolist()}, "rotation"),
        ({"transform_matrix": [[1, 0, 0, 1e300], [0, 1, 0, 0], [0, 0, 1, 0]]}, "transform_matrix"),
        ({"fl_x": "wide"}, "fl_x"),
        ({"w": 1e9, "h": 1e9}, "pixels a side"),
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR"),
        ({"k4": 0.1}, "k4"),
        ({"ftheta_p0": 0.0}, "ftheta_p0"),
    ],
)
def test_a_broken_frame_is_named(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    data = write_transforms(tmp_path, GLOBAL)
    data["frames"][1].update(change)
    rewrite(tmp_path, data)
    with pytest.raises(FormatError, match=words) as caught:
        load(tmp_path)
    assert "frame 1" in str(caught.value)


@pytest.mark.parametrize(
    ("keys", "said"), [(("k1", "k2", "p1", "p2"), 0), (("k1", "k2", "k3", "k4"), 1)], ids=["ngp", "either"]
)
def test_a_model_that_keys_name_is_no_guess(tmp_path: Path, caplog, keys: tuple[str, ...], said: int) -> None:
    data = write_transforms(tmp_path, GLOBAL)
    lens = dict.fromkeys(DISTORTING, 0.0) | {"k1": 0.01}
    rest = {key: value for key, value in data.items() if key not in ("camera_model", *DISTORTING)}
    rewrite(tmp_path, rest | {key: lens[key] for key in keys})
    load(tmp_path)
    assert len(caplog.messages) == said


def test_transforms_json_states_scale_and_drawn(tmp_path: Path) -> None:
    data = write_transforms(tmp_path, GLOBAL)
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


# Datasets that are broken or odd: what is sound loads, the rest is refused in one line. Files with bytes
# changed at random are tried by the fuzzer (tests/io/test_hostile.py).


def test_unknown_datasets_are_refused_with_known_kinds(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "scene.ply").write_bytes(b"ply")
    (tmp_path / "photo.jpg" / "inner").mkdir(parents=True)  # a folder that is called like a photograph
    for name in ("absent", "empty", "scene.ply", "photo.jpg", "."):
        assert "transforms.json" in refuse(tmp_path / name, tmp_path / "work")


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("a" * 5000 + ".png", ["b"]),  # no file system holds it
        ("b.png", ["b"]),  # listed twice
        ("mon été 1.png", ["b", "mon été 1"]),
    ],
)
def test_odd_names_in_a_model(tmp_path: Path, name: str, found: list[str]) -> None:
    listed = write_colmap(tmp_path, "txt") / "images.txt"
    listed.write_text(listed.read_text().replace("a.png", name), encoding="utf-8")
    (tmp_path / "images/a.png").rename(tmp_path / "images/mon été 1.png")
    assert [camera.name for camera in load_capture(tmp_path, CONFIG, tmp_path / "work").cameras] == found


@pytest.mark.parametrize(
    ("encoding", "name", "on_disk", "said"),
    [
        ("utf-8-sig", "é.png", "é.png", 0),
        ("utf-16", "é.png", "é.png", 0),
        ("utf-16-le", "é.png", "e\u0301.png", 0),
        ("cp1252", "é.png", "é.png", 1),
        ("utf-8", "left\\e\u0301.png", "left/é.png", 0),
        ("utf-8", ".\\left\\é.png", "left/\udce9.png", 0),  # unpacked from an archive of cp1252
    ],
)
@pytest.mark.parametrize("reader", ["COLMAP", "nerfstudio"])
def test_text_of_every_maker_is_read(tmp_path, reader, encoding, name, on_disk, said, caplog):
    if reader == "COLMAP":
        files, photos = sorted(write_colmap(tmp_path, "txt").iterdir()), tmp_path / "images"
    else:
        write_nerfstudio(tmp_path)
        files, photos = [tmp_path / "transforms.json"], tmp_path
    want = load_photographs(tmp_path, CONFIG, tmp_path / "work")
    (photos / "left").mkdir()
    (photos / "a.png").rename(photos / on_disk)
    for file in files:
        text = file.read_text("utf-8-sig")
        escaped = json.dumps(name, ensure_ascii=False)[1:-1]
        text = text.replace("a.png", name if reader == "COLMAP" else escaped)
        file.write_bytes(text.replace("\n", "\r\n").encode(encoding))
    caplog.clear()
    got = load_photographs(tmp_path, CONFIG, tmp_path / "work")
    assert len(caplog.messages) == said
    assert len(got) == len(want)
    assert got.points.tolist() == want.points.tolist()


# Changes that leave a dataset well-formed: the same comes out, or a line, or an error.


def changed_lines(text: str, rng: np.random.Generator) -> str:
    """A text with one line dropped, doubled, or swapped with another."""
    lines = text.split("\n")
    at, other = (int(row) for row in rng.choice(len(lines), 2, replace=False))
    kind = rng.integers(3)
    if kind == 2:
        lines[at], lines[other] = lines[other], lines[at]
    else:
        lines[at : at + 1] = [lines[at]] * (2 * int(kind))
    return "\n".join(lines)


def changed_json(text: str, rng: np.random.Generator) -> str:
    """A transforms.json with one entry or frame dropped, or frames doubled or in another order."""
    top = json.loads(text)
    frames: list[dict[str, Any]] = top["frames"]
    at = int(rng.integers(len(frames)))
    match rng.integers(5):
        case 0:
            del top[str(rng.choice(sorted(top.keys() - {"frames"})))]
        case 1:
            del frames[at]
        case 2:
            frames.append(frames[at])
        case 3:
            frames.append({**frames[at], "transform_matrix": frames[at - 1]["transform_matrix"]})
        case _:
            top["frames"] = frames[::-1]
    return json.dumps(top)


def summary(capture: Capture) -> list[Any]:
    """All that a training sees of a capture, whatever the order of points."""
    shown = [
        (c.name, c.intrinsics, c.world_to_camera.tolist(), image.tobytes())
        for c, image in zip(capture.cameras, capture.images, strict=True)
    ]
    return [shown, sorted(np.hstack([capture.points, capture.colours]).tolist())]


@pytest.mark.parametrize("seed", range(60))
@pytest.mark.parametrize("reader", ["cameras.txt", "images.txt", "points3D.txt", "transforms.json"])
def test_a_changed_dataset_gives_the_same_or_a_line(reader, seed, whole, caplog):
    (file,) = whole.glob(f"**/{reader}")
    folder = whole / ("nerfstudio" if reader == "transforms.json" else "colmap")
    want = summary(load_photographs(folder, CONFIG, whole))

    def check(found: Capture) -> None:
        assert summary(found) == want

    before = file.read_text()
    change = changed_json if reader == "transforms.json" else changed_lines
    try:
        file.write_text(change(before, np.random.default_rng(seed)))
        caplog.clear()
        same_or_a_line(lambda: load_photographs(folder, CONFIG, whole), check, caplog)
    finally:
        file.write_text(before)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same photographs and cameras as a COLMAP model in text and as a transforms.json."""
    folder = tmp_path_factory.mktemp("whole")
    matrices = poses(4)
    write_transforms(folder / "nerfstudio", stated(SMALL_LENS), SMALL_LENS, views=4)
    names = write_photos(folder / "colmap/images", SMALL_LENS, matrices)
    write_model(folder / "colmap/sparse/0", SMALL_LENS, names, matrices, FLOOR, "txt")
    return folder


def test_decimal_commas_are_refused_by_name(tmp_path: Path) -> None:
    (write_colmap(tmp_path, "txt") / "cameras.txt").write_text("1 PINHOLE 40 30 50,5 50 20 15\n")
    message = refuse(tmp_path, tmp_path / "work")
    assert "'50,5'" in message
    assert "decimal point" in message


@pytest.mark.parametrize("name", [None, 3, "", "absent.ply", "."])
def test_a_missing_cloud_is_replaced_by_random_points(tmp_path: Path, name: object) -> None:
    write_nerfstudio(tmp_path, ply_file_path=name)
    capture = load_capture(tmp_path, CONFIG, tmp_path / "work")
    assert len(capture.points) > 100  # random ones: a single view triangulates nothing


# Lenses, their inverses, and the pictures made from them.

WIDTH, HEIGHT = 320, 240
FOCAL = {"f": 260.0, "fx": 260.0, "fy": 255.0, "cx": 166.0, "cy": 117.0}
COEFFICIENTS = {"k1": -0.12, "k2": 0.03, "k3": -0.01, "k4": 0.004, "k5": 0.002, "k6": -0.001}
COEFFICIENTS |= {"p1": 0.001, "p2": -0.0015}
KEYS = {name: keys.split() for name, (_, _, keys) in LENSES.items()}


def parameters_of(model: str) -> Array:
    return np.array([(FOCAL | COEFFICIENTS)[key] for key in KEYS[model]])


PHONE = PhotoIntrinsics(640, 480, 600.0, 604.0, 326.0, 236.0, BrownDistortion(0.06, -0.08, -0.001, 0.0002))
BARREL = PhotoIntrinsics(640, 480, 420.0, 420.0, 310.0, 246.0, BrownDistortion(-0.25, 0.06))
FISHEYE = PhotoIntrinsics(640, 480, 400.0, 397.0, 322.0, 239.0, FisheyeDistortion(0.02, -0.01, 0.003, -0.001))
PLAIN = PhotoIntrinsics(640, 480, 500.0, 490.0, 310.0, 250.0)

DISTORTED = [lens_of(name, WIDTH, HEIGHT, parameters_of(name)) for name in KEYS if "PINHOLE" not in name]
DISTORTED += [PHONE, BARREL, FISHEYE]


@pytest.mark.parametrize("model", KEYS)
def test_pixels_agree_with_colmap(model: str) -> None:
    parameters = parameters_of(model)
    xy = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 2))
    xy[0] = 0  # the axis, where the fisheye formula divides zero by zero
    theirs = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=parameters)
    assert LENSES[model][0] == int(theirs.model.value)
    want = theirs.img_from_cam(np.concatenate([xy, np.ones((200, 1))], 1))
    found = lens_of(model, WIDTH, HEIGHT, parameters).pixels(xy)
    np.testing.assert_allclose(found, want, rtol=0, atol=1e-9)


@pytest.mark.parametrize("intrinsics", DISTORTED)
def test_undistort_then_distort_comes_back(intrinsics: PhotoIntrinsics) -> None:
    sides = np.linspace(0, intrinsics.width, 33), np.linspace(0, intrinsics.height, 25)
    pixels = np.stack(np.meshgrid(*sides), -1).reshape(-1, 2)
    distorted = (pixels - (intrinsics.cx, intrinsics.cy)) / (intrinsics.fx, intrinsics.fy)
    back = intrinsics.pixels(undistorted_points(intrinsics.distortion, distorted))
    assert np.abs(back - pixels).max() < 1e-6  # px


@pytest.mark.parametrize("intrinsics", DISTORTED)
def test_the_pinhole_shows_no_outside_and_wastes_little(intrinsics: PhotoIntrinsics) -> None:
    camera = pinhole_for(intrinsics, 10_000)
    outline = source_positions(intrinsics, camera)
    assert outline.min() >= 0
    assert (outline <= (intrinsics.width, intrinsics.height)).all()
    # Every edge lies close to the photograph's: nothing more than the rectangle's nature is cut off.
    margins = [
        outline[..., 0].min(),
        outline[..., 1].min(),
        intrinsics.width - outline[..., 0].max(),
        intrinsics.height - outline[..., 1].max(),
    ]
    assert max(margins) < 3  # px


def test_a_pinhole_keeps_the_whole_photograph() -> None:
    intrinsics = PhotoIntrinsics(1000, 601, 800.0, 810.0, 480.0, 310.0, BrownDistortion())
    assert intrinsics.distortion is None
    camera = pinhole_for(intrinsics, 500)
    assert (camera.width, camera.height) == (500, 300)
    np.testing.assert_allclose((camera.fx, camera.cx), (400.0, 240.0))
    np.testing.assert_allclose((camera.fy, camera.cy), (810 * 300 / 601, 310 * 300 / 601))
    assert pinhole_for(intrinsics, 5000).width == 1000  # never enlarged


@pytest.mark.parametrize("intrinsics", [PHONE, BARREL, FISHEYE, PLAIN])
@pytest.mark.parametrize("max_side", [10_000, 213])
def test_the_picture_is_what_the_pinhole_sees(intrinsics: PhotoIntrinsics, max_side: int) -> None:
    pose = poses(3)[1]
    posed = replace(pinhole_for(intrinsics, max_side), world_to_camera=pose)
    assert max(posed.width, posed.height) <= max_side
    positions = None if intrinsics.distortion is None else source_positions(intrinsics, posed)
    got = resample(Image.fromarray(photograph(intrinsics, pose)), intrinsics, posed, positions)
    # A shrunk picture averages over the area of its pixels; so must the truth.
    samples = 1 if max_side > 1000 else 4
    match = psnr(got, pinhole_picture(posed, samples))
    # The shrunk photograph has the right magnification at its centre; towards the edges of a barrel or
    # fisheye lens, which squeezes them, some detail is lost with the shrinking: 38.4 dB at worst.
    assert match > (40 if max_side > 1000 else 37)
    half_a_pixel_off = replace(posed, cx=posed.cx + 0.5)
    assert psnr(got, pinhole_picture(half_a_pixel_off, samples)) < match - 5


def test_a_wide_fisheye_is_cut_at_the_largest_angle() -> None:
    wide = PhotoIntrinsics(800, 800, 260.0, 260.0, 400.0, 400.0, FisheyeDistortion())  # 176 degrees across
    camera = pinhole_for(wide, 800)
    corner = np.hypot(camera.cx / camera.fx, camera.cy / camera.fy)
    assert np.degrees(np.arctan(corner)) == pytest.approx(65, abs=0.5)


def test_a_lens_that_folds_over_is_cut_before_the_fold() -> None:
    folds_at_0_91 = BrownDistortion(-0.4)
    folding = PhotoIntrinsics(640, 480, 300.0, 300.0, 320.0, 240.0, folds_at_0_91)
    camera = pinhole_for(folding, 2000)
    corner = np.hypot(camera.cx / camera.fx, camera.cy / camera.fy)
    assert 0.5 < corner < 0.92
    assert source_positions(folding, camera).min() >= 0


@pytest.mark.parametrize("k1", [np.nan, 1e300, -1e12])
def test_an_impossible_lens_is_refused(k1: float) -> None:
    intrinsics = PhotoIntrinsics(640, 480, 300.0, 300.0, 320.0, 240.0, BrownDistortion(k1))
    with pytest.raises(InputError):
        pinhole_for(intrinsics, 800)
