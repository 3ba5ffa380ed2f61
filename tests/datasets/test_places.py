"""How long a unit is by the places of photographs."""

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from langsplat_core.arrays import Array
from langsplat_core.config import DatasetConfig
from langsplat_core.datasets import load_capture
from langsplat_core.datasets.capture import metres_per_unit, on_the_ground, place
from langsplat_core.datasets.intrinsics import PhotoIntrinsics
from tests.support.photographed import colmap_reconstruction, poses, write_photos

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
def test_a_way_in_metres_says_how_long_a_unit_is(around: tuple[float, float]) -> None:
    found = metres_per_unit(located(walk(), 2.5), places_at(walk(), around))
    assert found == pytest.approx(2.5, rel=0.008)  # the earth is no sphere


def test_an_arc_of_the_meridian_and_of_a_parallel() -> None:
    """A degree at 45 degrees north is 111 132 m to the north and 78 847 m to the east (WGS 84)."""
    ground = on_the_ground(np.array([[45.0, 7.0], [45.001, 7.0], [45.0, 7.001]]))
    assert_allclose(ground, [[0, 0], [0, 111.132], [78.847, 0]], atol=2e-3)


@pytest.mark.parametrize("seed", range(5))
def test_places_that_err_by_less_than_the_way_is_long(seed: int) -> None:
    noise = np.random.default_rng(seed).normal(scale=3.0, size=(40, 2))
    found = metres_per_unit(located(walk(), 2.5), places_at(walk() + noise))
    assert found == pytest.approx(2.5, rel=0.05)


@pytest.mark.parametrize("seed", range(5))
def test_around_a_thing_places_say_nothing(seed: int) -> None:
    """Two metres around a table, and places that err by four."""
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    circle = 2 * np.stack([np.cos(angle), np.sin(angle)], 1)
    noise = np.random.default_rng(seed).normal(scale=4.0, size=(40, 2))
    assert metres_per_unit(located(circle, 1.0), places_at(circle + noise)) is None


def test_one_place_for_all_says_nothing() -> None:
    assert metres_per_unit(located(walk(), 1.0), places_at(0 * walk())) is None
    assert metres_per_unit(np.ones((9, 3)), places_at(walk(9))) is None


def test_the_place_of_a_photograph(photo: Path) -> None:
    assert_allclose(place(tagged(photo, parts(33.9), parts(18.4), ("S", "W"))), (-33.9, -18.4), atol=1e-7)
    assert_allclose(place(tagged(photo, parts(HERE[0]), parts(HERE[1]))), HERE, atol=1e-7)


@pytest.mark.parametrize(
    ("latitude", "signs"),
    [
        ((91.0, 0.0, 0.0), ("N", "E")),
        ((IFDRational(1, 0), 0.0, 0.0), ("N", "E")),
        ((47.0, 22.0), ("N", "E")),
        ((47.0, 22.0, 1.0), ("X", "E")),
    ],
)
def test_what_is_no_place(photo: Path, latitude: object, signs: tuple[str, str]) -> None:
    assert all(map(math.isnan, place(tagged(photo, latitude, parts(8.0), signs))))


def test_a_photograph_without_a_place_or_that_cannot_be_read(photo: Path) -> None:
    assert all(map(math.isnan, place(photo)))
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
