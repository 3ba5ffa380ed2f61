"""Captures: digests, held-out views, the length of a unit, random points."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from langsplat_core.arrays import Array
from langsplat_core.config import DatasetConfig
from langsplat_core.datasets import Capture, load_capture
from langsplat_core.datasets.capture import metres_per_unit, random_points, split_views, surrounded_views
from langsplat_core.datasets.intrinsics import PhotoIntrinsics
from langsplat_core.datasets.photos import ExifFacts, exif_facts
from langsplat_core.errors import InputError
from langsplat_core.scene import Camera, look_at
from langsplat_core.scene.transform import moving, rotating, scaling
from tests.support.photographs import poses, write_model, write_nerfstudio, write_photos, write_picture
from tests.support.scenes import random_camera, ring


def captured(error: float = 0.0) -> Capture:
    """Three cameras and ten points, every number of their poses and places off by at most `error`."""
    rng, noise = np.random.default_rng(1), np.random.default_rng(2)
    cameras = []
    for number in range(3):
        pose = random_camera(number).world_to_camera.copy()
        pose[:3] += error * noise.uniform(-1, 1, (3, 4))
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


@pytest.mark.parametrize("lens", [{}, {"k1": 0.2, "p2": 0.01}])
def test_read_at_gives_what_reading_at_that_size_gives(tmp_path: Path, lens: dict[str, float]) -> None:
    write_nerfstudio(tmp_path, **lens)
    write_picture(tmp_path / "masks/a.png", seed=1)
    large, small = (load_capture(tmp_path, DatasetConfig(max_side=n), tmp_path / "work") for n in (40, 24))
    large = replace(large, points=small.points, colours=small.colours)  # random ones
    again = large.read_at([0], 24)
    assert again.digest([0]) == small.digest([0]) != large.shrunk([0], 24).digest([0])
    assert large.read_at([0], 40).images[0] is large.images[0]
    made = replace(large, photos=())
    assert made.read_at([0], 24).digest([0]) == large.shrunk([0], 24).digest([0])
    (tmp_path / "a.png").unlink()
    with pytest.raises(InputError, match=r"a\.png"):
        large.read_at([0], 24)


# Held-out views lie among training views, all over the capture, and are the same on every machine.

UP = np.array([0.0, 0.0, 1.0])

SIZE = (32, 24)


def row(count: int) -> list[Camera]:
    return [look_at(np.array([k, 0, 0.0]), np.array([k, 5.0, 0]), UP, SIZE) for k in range(count)]


@pytest.mark.parametrize(("count", "expected"), [(3, 0), (5, 0), (6, 1), (7, 1), (12, 2), (40, 5)])
def test_one_view_in_eight_is_held_out_of_enough(count, expected):
    for cameras in (ring(count, SIZE), row(count)):
        found = surrounded_views(cameras, 8)
        assert len(found) == len(set(found)) == expected


def test_the_ends_of_a_walk_and_their_neighbours_are_trained_on():
    for count in (9, 20, 41):
        found = surrounded_views(row(count), 8)
        assert min(found) >= 2
        assert max(found) <= count - 3
        assert np.all(np.diff(found) > 2)


def test_a_view_on_its_own_is_trained_on():
    alone = look_at(np.array([0.0, 0, 9]), np.zeros(3), np.array([0.0, 1, 0]), SIZE)
    turned = look_at(np.array([3.0, 0, 1]), np.array([9.0, 0, 1]), UP, SIZE)  # looks away from the rest
    found = surrounded_views([alone, *ring(14, SIZE), turned], 4)
    assert len(found) == 4
    assert not {0, 15} & set(found)


def test_held_out_views_survive_rounding_and_similarity():
    rng = np.random.default_rng(0)
    eyes = rng.normal(0, 2, (23, 3))
    cameras = [look_at(eye, rng.normal(0, 0.3, 3), UP, SIZE) for eye in eyes]
    to = moving(np.array([3.0, -7, 1])).then(rotating(np.array([1.0, 2, 3]), 77)).then(scaling(0.03))
    assert surrounded_views([to.camera(camera) for camera in cameras], 8) == surrounded_views(cameras, 8)
    shaken = [
        replace(camera, world_to_camera=camera.world_to_camera * (1 + 1e-13 * rng.normal()))
        for camera in ring(24, SIZE)
    ]
    assert surrounded_views(shaken, 8) == surrounded_views(ring(24, SIZE), 8)


def test_every_eighth_view_by_name_is_held_out():
    cameras = tuple(replace(camera, name=f"v{k}") for k, camera in enumerate(ring(10, SIZE)))
    images = tuple(np.zeros((SIZE[1], SIZE[0], 3), np.uint8) for _ in cameras)
    capture = Capture(cameras, images, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    assert split_views(capture, DatasetConfig(hold_out="every", test_every=4))[1] == [0, 4, 8]
    train, held_out = split_views(capture, DatasetConfig(test_every=8))
    assert len(held_out) == 1
    assert sorted(train + held_out) == list(range(10))


# How long a unit is by the places of photographs.

HERE = (47.3769, 8.5417)  # degrees

LENS = PhotoIntrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)


def places_at(metres: Array, around: tuple[float, float] = HERE) -> Array:
    """Map (K, 2) metres east and north to (K, 2) degrees, on a sphere."""
    north = np.degrees(metres[:, 1] / 6_371_000)
    east = np.degrees(metres[:, 0] / 6_371_000 / math.cos(math.radians(around[0])))
    return np.stack([around[0] + north, (around[1] + east + 180) % 360 - 180], 1)


def walk(count: int = 40, length: float = 80.0) -> Array:
    """Return (K, 2) metres: a bent way."""
    along = np.linspace(0, 1, count)
    return length * np.stack([along, 0.3 * np.sin(4 * along)], 1)


def located(metres: Array, unit: float) -> Array:
    """Return (K, 3) camera positions of another world, in which a unit is so many metres."""
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    return np.column_stack([metres, np.zeros(len(metres))]) @ turn / unit + 7.0


def tagged(
    path: Path,
    latitude: object,
    longitude: object,
    signs: tuple[object, object] = ("N", "E"),
    date: str = "2026:05:03 14:02:59",
) -> Path:
    """A photograph's copy that names a place."""
    exif = Image.Exif()
    exif[0x0132] = date
    exif.get_ifd(0x8825).update({1: signs[0], 2: latitude, 3: signs[1], 4: longitude})
    with Image.open(path) as picture:
        picture.copy().save(path, exif=exif)
    return path


def parts(degrees: float) -> tuple[float, float, IFDRational]:
    """Degrees, minutes and seconds, as cameras write them."""
    minutes, seconds = divmod(round(abs(degrees) * 3600, 4), 60)
    return float(minutes // 60), float(minutes % 60), IFDRational(round(seconds * 10_000), 10_000)


@pytest.mark.parametrize("around", [HERE, (-33.9, 18.4), (64.1, 179.9999), (0.01, -179.9999)])
def test_scale_follows_from_places_along_a_walk(around: tuple[float, float]) -> None:
    found = metres_per_unit(located(walk(), 2.5), places_at(walk(), around))
    assert found == pytest.approx(2.5, rel=0.008)  # the earth is no sphere


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


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    Image.new("RGB", (8, 8)).save(tmp_path / "a.jpg")
    return tmp_path / "a.jpg"


def test_the_place_of_a_photograph(photo: Path) -> None:
    there = exif_facts(tagged(photo, parts(33.9), parts(18.4), ("S", "W"))).place
    np.testing.assert_allclose(there, (-33.9, -18.4), atol=1e-7)
    np.testing.assert_allclose(exif_facts(tagged(photo, *map(parts, HERE))).place, HERE, atol=1e-7)


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
    tagged(photo, latitude, parts(8.0), (north, "E"), date="some day in May")
    assert repr(exif_facts(photo)) == repr(ExifFacts())  # NaN is not itself
    photo.write_bytes(b"no photograph")
    assert repr(exif_facts(photo)) == repr(ExifFacts())


def test_a_capture_gets_its_scale_from_its_photographs(tmp_path: Path) -> None:
    """Cameras a few units apart whose photographs are tens of metres apart."""
    seen = poses(8)
    names = write_photos(tmp_path / "images", LENS, seen)
    write_model(tmp_path / "sparse" / "0", LENS, names, seen)
    config = DatasetConfig()

    def loaded(config: DatasetConfig) -> float | None:
        return load_capture(tmp_path, config, tmp_path / "work").metres_per_unit

    capture = load_capture(tmp_path, config, tmp_path / "work")
    assert (capture.metres_per_unit, capture.taken) == (None, "")
    eyes = np.array([camera.position for camera in capture.cameras])
    level = np.linalg.svd(eyes - eyes.mean(0))[2][:2]  # the plane that they lie in
    places = places_at(20 * (eyes - eyes[0]) @ level.T)
    for photo, place in zip(capture.photos, places, strict=True):
        tagged(photo.path, *map(parts, place))
    assert loaded(config) == pytest.approx(20, rel=0.01)
    tagged(capture.photos[3].path, parts(90.0), parts(0.0), ("N", "N"), "2026:05:04 09:00:00")  # no place
    taken = load_capture(tmp_path, config, tmp_path / "work").taken
    assert re.fullmatch(r"2026-05-03 14:02 to 2026-05-04 09:00, places \(GPS\) within \d+ m", taken)
    assert loaded(DatasetConfig(metres_per_unit=3.0)) == 3.0


# Random points lie where the cameras look, whatever the cameras do.

NONE = np.zeros((0, 3))


def pictures(count: int) -> list[Array]:
    """Uniform pictures of different greys."""
    return [np.full((24, 32, 3), 10 * index, np.uint8) for index in range(count)]


def drawn(cameras: list[Camera], known: Array = NONE, seed: int = 0) -> tuple[Array, Array]:
    count, nothing = len(cameras), (NONE, NONE.astype(np.uint8))
    capture = Capture(tuple(cameras), tuple(pictures(count)), *nothing)
    return random_points(500, known, capture, range(count), np.random.default_rng(seed))


def test_points_lie_where_half_of_the_cameras_look():
    cameras = ring(8, SIZE)
    points, colours = drawn(cameras)
    assert points.shape == colours.shape == (500, 3)
    assert colours.dtype == np.uint8
    seen = np.sum([camera.in_image(*camera.project(points)) for camera in cameras], axis=0)
    assert (seen >= 4).mean() > 0.9
    np.testing.assert_array_equal(points, drawn(cameras)[0])
    assert not np.array_equal(points, drawn(cameras, seed=1)[0])


def test_depths_follow_known_points():
    cameras = ring(6, SIZE)
    known = np.random.default_rng(3).uniform(-0.1, 0.1, (200, 3))
    points, _ = drawn(cameras, known)
    assert np.linalg.norm(points, axis=1).max() < 3
    assert np.linalg.norm(drawn(cameras)[0], axis=1).max() > 3  # without them depths reach to three times 4
