"""Captures: digests, memory, photographs of every kind, the length of a unit, random points."""

import errno
import math
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image, ImageOps
from PIL.TiffImagePlugin import IFDRational

from langsplat_core.arrays import Array
from langsplat_core.config import DatasetConfig
from langsplat_core.datasets import Capture, load_capture
from langsplat_core.datasets.capture import metres_per_unit, on_the_ground
from langsplat_core.datasets.exif import place
from langsplat_core.datasets.intrinsics import PhotoIntrinsics
from langsplat_core.datasets.known_poses import look_distance, random_points
from langsplat_core.datasets.photos import Album, count_photographs, read_photo, unique_names
from langsplat_core.errors import InputError
from langsplat_core.scene import Camera, look_at
from tests.support.photographs import (
    CONFIG,
    colmap_reconstruction,
    poses,
    refuse,
    write_colmap,
    write_nerfstudio,
    write_photos,
    write_picture,
)
from tests.support.processes import files_of_at_most


def captured(error: float = 0.0) -> Capture:
    """Three cameras and ten points, every number of their poses and places off by at most `error`."""
    rng, noise = np.random.default_rng(1), np.random.default_rng(2)
    cameras = []
    for number in range(3):
        pose = np.eye(4)
        pose[:3] += 0.1 * rng.normal(size=(3, 4)) + error * noise.uniform(-1, 1, (3, 4))
        cameras.append(Camera(4, 3, 5.0, 5.0, 2.0, 1.5, pose, f"view_{number}"))
    points = rng.normal(size=(10, 3)) + error * noise.uniform(-1, 1, (10, 3))
    images = tuple(rng.integers(0, 256, (3, 4, 3), dtype=np.uint8) for _ in cameras)
    return Capture(tuple(cameras), images, points, np.zeros((10, 3), np.uint8))


def test_rounding_of_another_processor_changes_no_digest():
    assert captured(1e-14).digest([0, 1, 2]) == captured().digest([0, 1, 2])
    zero = replace(captured(), points=np.zeros((10, 3)))
    assert replace(zero, points=-zero.points).digest([0]) == zero.digest([0])


@pytest.mark.parametrize("indices", [[0, 1], [1, 0, 2]])
def test_digest_changes_with_views_and_world(indices: list[int]):
    assert captured().digest(indices) != captured().digest([0, 1, 2])
    assert captured(1e-6).digest(indices) != captured().digest(indices)


# Photographs beyond the limit lie in files, and are the same pictures.


def test_album_files_images_unchanged_beyond_memory(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    pictures = np.random.default_rng(0).integers(256, size=(5, 6, 8, 3)).astype(np.uint8)
    album = Album(in_memory=2 * pictures[0].nbytes + 1)
    kept = [album.keep(picture) for picture in pictures]
    assert [isinstance(picture, np.memmap) for picture in kept] == [False, False, True, True, True]
    np.testing.assert_array_equal(np.stack(kept), pictures)
    assert list(tmp_path.iterdir()) == []  # the files have no name: nothing is left behind


def test_album_raises_where_the_disk_is_full(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    picture = np.zeros((60, 80, 3), np.uint8)
    for size in (0, picture.nbytes - 1):
        with files_of_at_most(size), pytest.raises(OSError, match="large") as caught:
            Album(in_memory=0).keep(picture)
        assert (caught.value.errno, caught.value.filename) == (errno.EFBIG, str(tmp_path))


# Photographs of every kind, and broken ones: what is sound loads, the rest is left out and named.


def test_every_kind_of_picture_becomes_rgb(tmp_path: Path) -> None:
    grey = np.linspace(0, 255, 12 * 16).reshape(12, 16).astype(np.uint8)
    picture = Image.fromarray(grey)
    deep = Image.fromarray(grey.astype(np.uint16) * 257)
    pictures = {
        "grey.png": picture,
        "deep.png": deep,
        "deep.tif": deep,
        "palette.png": picture.convert("P"),
        "ink.tif": picture.convert("CMYK"),
        "both.png": Image.merge("LA", [picture, Image.new("L", picture.size, 255)]),
        "one.webp": picture.convert("RGB"),
    }
    for name, kind in pictures.items():
        kind.save(tmp_path / name, **({"lossless": True} if name.endswith("webp") else {}))
        got = np.asarray(read_photo(tmp_path / name, upright=False))
        assert got.shape == (12, 16, 3), name
        assert np.abs(got.astype(int) - grey[..., None]).max() <= 1, name


@pytest.mark.parametrize("orientation", range(1, 9))
def test_every_exif_orientation(tmp_path: Path, orientation: int) -> None:
    picture = Image.fromarray(np.random.default_rng(0).integers(0, 256, (6, 9, 3), dtype=np.uint8))
    exif = Image.Exif()
    exif[0x0112] = orientation
    picture.save(tmp_path / "a.png", exif=exif)
    want = np.asarray(ImageOps.exif_transpose(Image.open(tmp_path / "a.png")))
    assert want.shape == ((6, 9, 3) if orientation < 5 else (9, 6, 3))
    np.testing.assert_array_equal(np.asarray(read_photo(tmp_path / "a.png", upright=True)), want)
    np.testing.assert_array_equal(np.asarray(read_photo(tmp_path / "a.png", upright=False)), picture)


def test_broken_exif_data_count_as_none(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.png")
    Image.open(tmp_path / "a.png").save(tmp_path / "b.jpg", exif=b"Exif\x00\x00MM\x00*\xff\xff\xff\xff junk")
    assert read_photo(tmp_path / "b.jpg", upright=True).size == (40, 30)


def bomb(path: Path) -> None:
    """A PNG of a hundred bytes whose header claims 60 000 x 60 000 pixels."""
    write_picture(path)
    data = bytearray(path.read_bytes())
    data[16:24] = struct.pack(">II", 60_000, 60_000)
    path.write_bytes(data)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(path.read_bytes()[:200]),
        lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100)),
        lambda path: path.write_bytes(b"GIF89a" + bytes(20)),
        bomb,
    ],
)
def test_a_broken_photograph_is_left_out_and_named(
    tmp_path: Path,
    spoil,  # type: ignore[no-untyped-def]
    caplog: pytest.LogCaptureFixture,
) -> None:
    write_colmap(tmp_path)
    spoil(tmp_path / "images/a.png")
    capture = load_capture(tmp_path, CONFIG, tmp_path / "work")
    assert [camera.name for camera in capture.cameras] == ["b"]
    assert "a.png" in caplog.text

    spoil(tmp_path / "images/b.png")
    assert "a.png" in refuse(tmp_path, tmp_path / "work")


@pytest.mark.parametrize("lens", [{}, {"k1": 0.2, "p2": 0.01}])
def test_read_at_gives_what_reading_at_that_size_gives(tmp_path: Path, lens: dict[str, float]) -> None:
    write_nerfstudio(tmp_path, **lens)
    write_picture(tmp_path / "masks/a.png", seed=1)
    large, small = (
        load_capture(tmp_path, DatasetConfig(max_side=side), tmp_path / "work") for side in (40, 24)
    )
    large = replace(large, points=small.points, colours=small.colours)  # random ones
    again = large.read_at([0], 24)
    assert again.digest([0]) == small.digest([0]) != large.shrunk([0], 24).digest([0])
    assert large.read_at([0], 40).images[0] is large.images[0]
    made = replace(large, photos=())
    assert made.read_at([0], 24).digest([0]) == large.shrunk([0], 24).digest([0])
    (tmp_path / "a.png").unlink()
    with pytest.raises(InputError, match=r"a\.png"):
        large.read_at([0], 24)


def test_an_absurd_camera_size_is_refused(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path, "txt")
    (folder / "cameras.txt").write_text("1 PINHOLE 40000000 30 50 50 20 15\n")
    assert "camera 1: a photograph of more than 1048576 pixels" in refuse(tmp_path, tmp_path / "work")


def test_names_stay_unique() -> None:
    assert unique_names(["a.png", "b.jpg"]) == ["a", "b"]
    assert unique_names(["l/a.png", "r/a.png"]) == ["l_a", "r_a"]
    assert unique_names(["a.png", "a.jpg"]) == ["a_png", "a_jpg"]


def test_photographs_are_counted_where_they_lie(tmp_path: Path) -> None:
    assert count_photographs(tmp_path / "gone") == 0
    for name in ("a.jpg", "b.PNG", "c.txt"):
        (tmp_path / name).write_bytes(b"")
    assert count_photographs(tmp_path) == 2
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.jpg").write_bytes(b"")
    (tmp_path / "transforms.json").write_text("{}")
    assert count_photographs(tmp_path) == count_photographs(tmp_path / "transforms.json") == 1
    assert count_photographs(tmp_path / "walk.mp4") == DatasetConfig.frames


# How long a unit is by the places of photographs.

HERE = (47.3769, 8.5417)  # degrees
LENS = PhotoIntrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)


def places_at(metres: Array, around: tuple[float, float] = HERE) -> Array:
    """(K, 2) metres east and north -> (K, 2) degrees, on a sphere."""
    north = np.degrees(metres[:, 1] / 6_371_000)
    east = np.degrees(metres[:, 0] / 6_371_000 / math.cos(math.radians(around[0])))
    return np.stack([around[0] + north, (around[1] + east + 180) % 360 - 180], 1)


def walk(count: int = 40, length: float = 80.0) -> Array:
    """(K, 2) metres: a bent way."""
    along = np.linspace(0, 1, count)
    return length * np.stack([along, 0.3 * np.sin(4 * along)], 1)


def located(metres: Array, unit: float) -> Array:
    """(K, 3) camera positions of another world, in which a unit is so many metres."""
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    return np.column_stack([metres, np.zeros(len(metres))]) @ turn / unit + 7.0


def tagged(
    path: Path, latitude: object, longitude: object, signs: tuple[object, object] = ("N", "E")
) -> Path:
    """A photograph's copy that names a place."""
    exif = Image.Exif()
    exif[0x0112] = 1  # else Pillow takes it for empty
    exif.get_ifd(0x8825).update({1: signs[0], 2: latitude, 3: signs[1], 4: longitude})
    with Image.open(path) as picture:
        picture.copy().save(path, exif=exif)
    return path


def parts(degrees: float) -> tuple[float, float, IFDRational]:
    """Degrees, minutes and seconds, as cameras write them."""
    minutes, seconds = divmod(round(abs(degrees) * 3600, 4), 60)
    return float(minutes // 60), float(minutes % 60), IFDRational(round(seconds * 10_000), 10_000)


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    Image.new("RGB", (8, 8)).save(tmp_path / "a.jpg")
    return tmp_path / "a.jpg"


@pytest.mark.parametrize("around", [HERE, (-33.9, 18.4), (64.1, 179.9999), (0.01, -179.9999)])
def test_scale_follows_from_places_along_a_walk(around: tuple[float, float]) -> None:
    found = metres_per_unit(located(walk(), 2.5), places_at(walk(), around))
    assert found == pytest.approx(2.5, rel=0.008)  # the earth is no sphere


def test_ground_distances_follow_the_ellipsoid() -> None:
    """A degree at 45 degrees north is 111 132 m to the north and 78 847 m to the east (WGS 84)."""
    ground = on_the_ground(np.array([[45.0, 7.0], [45.001, 7.0], [45.0, 7.001]]))
    assert_allclose(ground, [[0, 0], [0, 111.132], [78.847, 0]], atol=2e-3)


@pytest.mark.parametrize("seed", range(5))
def test_scale_bears_noisy_places_on_a_long_walk(seed: int) -> None:
    noise = np.random.default_rng(seed).normal(scale=3.0, size=(40, 2))
    found = metres_per_unit(located(walk(), 2.5), places_at(walk() + noise))
    assert found == pytest.approx(2.5, rel=0.05)


@pytest.mark.parametrize("seed", range(5))
def test_scale_is_unknown_where_places_are_noisier_than_the_walk(seed: int) -> None:
    """Two metres around a table, and places that err by four."""
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    circle = 2 * np.stack([np.cos(angle), np.sin(angle)], 1)
    noise = np.random.default_rng(seed).normal(scale=4.0, size=(40, 2))
    assert metres_per_unit(located(circle, 1.0), places_at(circle + noise)) is None


def test_scale_is_unknown_from_one_place() -> None:
    assert metres_per_unit(located(walk(), 1.0), places_at(0 * walk())) is None
    assert metres_per_unit(np.ones((9, 3)), places_at(walk(9))) is None


def test_the_place_of_a_photograph(photo: Path) -> None:
    assert_allclose(place(tagged(photo, parts(33.9), parts(18.4), ("S", "W"))), (-33.9, -18.4), atol=1e-7)
    assert_allclose(place(tagged(photo, parts(HERE[0]), parts(HERE[1]))), HERE, atol=1e-7)


@pytest.mark.parametrize(
    ("latitude", "north"),
    [
        ((91.0, 0.0, 0.0), "N"),
        ((IFDRational(1, 0), 0.0, 0.0), "N"),
        ((47.0, 22.0), "N"),
        ((47.0, 22.0, 1.0), "X"),
    ],
)
def test_implausible_exif_places_are_unknown(photo: Path, latitude: object, north: str) -> None:
    assert all(map(math.isnan, place(photo)))
    assert all(map(math.isnan, place(tagged(photo, latitude, parts(8.0), (north, "E")))))
    photo.write_bytes(b"no photograph")
    assert all(map(math.isnan, place(photo)))


def test_a_capture_gets_its_scale_from_its_photographs(tmp_path: Path) -> None:
    """Cameras a few units apart whose photographs are tens of metres apart."""
    seen = poses(8)
    names = write_photos(tmp_path / "images", LENS, seen)
    params = [LENS.fx, LENS.fy, LENS.cx, LENS.cy]
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    model = colmap_reconstruction("PINHOLE", (LENS.width, LENS.height), params, names, seen)
    model.write_binary(tmp_path / "sparse" / "0")
    config = DatasetConfig()

    def loaded(config: DatasetConfig) -> float | None:
        return load_capture(tmp_path, config, tmp_path / "work").metres_per_unit

    capture = load_capture(tmp_path, config, tmp_path / "work")
    assert capture.metres_per_unit is None
    eyes = np.array([camera.position for camera in capture.cameras])
    level = np.linalg.svd(eyes - eyes.mean(0))[2][:2]  # the plane that they lie in
    for photo, (latitude, longitude) in zip(
        capture.photos, places_at(20 * (eyes - eyes[0]) @ level.T), strict=True
    ):
        tagged(photo.path, parts(latitude), parts(longitude))
    assert loaded(config) == pytest.approx(20, rel=0.01)
    assert loaded(DatasetConfig(metres_per_unit=3.0)) == 3.0


# Random points lie where the cameras look, whatever the cameras do.

UP = np.array([0.0, -1.0, 0.0])
NONE = np.zeros((0, 3))


def ring(count: int, radius: float = 4.0) -> list[Camera]:
    """Cameras on a circle that look at its centre."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    eyes = [radius * np.array([np.cos(a), 0.1, np.sin(a)]) for a in angles]
    return [look_at(eye, np.zeros(3), UP, (32, 24)) for eye in eyes]


def pictures(count: int) -> list[Array]:
    """Uniform pictures of different greys."""
    return [np.full((24, 32, 3), 10 * index, np.uint8) for index in range(count)]


def drawn(cameras: list[Camera], known: Array = NONE, seed: int = 0) -> tuple[Array, Array]:
    generator = np.random.default_rng(seed)
    return random_points(500, known, cameras, pictures(len(cameras)), generator)


def test_points_lie_where_half_of_the_cameras_look():
    cameras = ring(8)
    points, colours = drawn(cameras)
    assert points.shape == colours.shape == (500, 3)
    assert colours.dtype == np.uint8
    seen = np.sum([camera.in_image(*camera.project(points)) for camera in cameras], axis=0)
    assert (seen >= 4).mean() > 0.9
    np.testing.assert_array_equal(points, drawn(cameras)[0])
    assert not np.array_equal(points, drawn(cameras, seed=1)[0])


def test_depths_follow_known_points():
    cameras = ring(6)
    known = np.random.default_rng(3).uniform(-0.1, 0.1, (200, 3))
    points, _ = drawn(cameras, known)
    assert np.linalg.norm(points, axis=1).max() < 3
    assert np.linalg.norm(drawn(cameras)[0], axis=1).max() > 3  # without them depths reach to three times 4


@pytest.mark.parametrize("count", [1, 3])
def test_axes_that_do_not_meet(count: int) -> None:
    eyes = [np.array([float(i), 0, 0]) for i in range(count)]
    cameras = [look_at(eye, eye + (0, 0, 1), UP, (32, 24)) for eye in eyes]
    assert 0 < look_distance(cameras) < 1e6
    points, _ = drawn(cameras)
    assert len(points) == 500
    assert np.isfinite(points).all()
    assert (points[:, 2] > 0).all()
