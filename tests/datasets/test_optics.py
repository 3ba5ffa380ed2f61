"""The lens of a photograph, as COLMAP learns of it from our smaller copy."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from langsplat_core.config import DatasetConfig
from langsplat_core.datasets import load_capture
from langsplat_core.datasets.sfm import optics
from langsplat_core.progress import Cancelled

pytestmark = pytest.mark.long

FOCAL, ON_FILM, PLANE_X, PLANE_UNIT, WIDTH = 0x920A, 0xA405, 0xA20E, 0xA210, 0xA002


def photo(path: Path, tags: dict[int, float], size: tuple[int, int] = (2000, 1500)) -> Path:
    exif = Image.Exif()
    exif[0x010F] = "Maker"
    exif.get_ifd(0x8769).update(tags)
    exif.get_ifd(0x8825).update({1: "N", 2: (47.0, 22.0, 0.0), 3: "E", 4: (8.0, 32.0, 0.0)})  # a place
    Image.linear_gradient("L").resize(size).convert("RGB").save(path, exif=exif)
    return path


def on_film(path: Path) -> float | None:
    return optics(path).get_ifd(0x8769).get(ON_FILM)


@pytest.mark.parametrize(("unit", "millimetres"), [(2, 25.4), (3, 10.0), (4, 1.0), (None, 25.4)])
def test_a_sensor_counted_by_the_inch(unit: int | None, millimetres: float, tmp_path: Path) -> None:
    """A sensor 22.3 mm wide, of 4 to 3, 4000 pixels; the file was made smaller since."""
    tags: dict[int, float] = {FOCAL: 18.0, PLANE_X: 4000 / 22.3 * millimetres, WIDTH: 4000}
    if unit is not None:
        tags[PLANE_UNIT] = unit
    expected = 18 / (22.3 * 1.25) * np.hypot(36, 24)
    assert on_film(photo(tmp_path / "a.jpg", tags)) == round(expected)


@pytest.mark.parametrize(
    "tags",
    [
        {},
        {FOCAL: 18.0},
        {FOCAL: 18.0, PLANE_X: 0.0},
        {FOCAL: 0.0, PLANE_X: 4500.0},
        {FOCAL: 18.0, PLANE_X: 4500.0, PLANE_UNIT: 77},
        {FOCAL: 1e6, PLANE_X: 1e9},
    ],
)
def test_what_is_no_lens_is_left_out(tags: dict[int, float], tmp_path: Path) -> None:
    assert on_film(photo(tmp_path / "a.jpg", tags)) is None


def test_what_the_camera_says_itself_counts(tmp_path: Path) -> None:
    assert on_film(photo(tmp_path / "a.jpg", {ON_FILM: 31, FOCAL: 18.0, PLANE_X: 4500.0})) == 31


def test_colmap_begins_with_it(tmp_path: Path) -> None:
    """The database's camera, of photographs that were shrunk; where they were taken is not passed on."""
    for index in range(3):
        photo(tmp_path / f"{index}.jpg", {FOCAL: 18.0, PLANE_X: 4000 / 22.3 * 25.4, WIDTH: 4000})

    def cancel(label: str, _: float) -> None:
        if label == "matching photographs":
            raise Cancelled

    with pytest.raises(Cancelled):
        load_capture(tmp_path, DatasetConfig(), tmp_path / "work", cancel)
    (stage,) = (tmp_path / "work").glob("sfm-*")
    with pycolmap.Database.open(stage / "database.db") as database:
        (camera,) = database.read_all_cameras()
        assert database.num_pose_priors() == 0
    assert (camera.width, camera.height) == (1600, 1200)
    assert camera.has_prior_focal_length
    assert camera.focal_length == pytest.approx(18 / 22.3 * 1600, rel=0.02)  # whole millimetres
