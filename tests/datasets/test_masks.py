"""Masks beside photographs: found, laid onto photographs, kept out of features and of training."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from langsplat_core.arrays import Array
from langsplat_core.config import RadianceConfig
from langsplat_core.datasets import sfm
from langsplat_core.datasets.capture import Capture
from langsplat_core.datasets.intrinsics import PhotoIntrinsics
from langsplat_core.datasets.photos import Photo, develop, find_photos, mask_beside
from langsplat_core.errors import InputError
from langsplat_core.progress import silent
from langsplat_core.scene import look_at
from langsplat_core.training.radiance.scores import evaluate_views
from langsplat_core.training.radiance.trainer import train_radiance
from tests.support.photographs import poses, write_photos

LENS = PhotoIntrinsics(120, 90, 110.0, 110.0, 60.0, 45.0)


def write_mask(path: Path, mask: Array) -> Path:
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(np.where(mask, np.uint8(255), np.uint8(0))).save(path)
    return path


@pytest.mark.parametrize("place", ["images/masks", "masks"])
@pytest.mark.parametrize("name", ["a.jpg.png", "a.png"])
def test_a_mask_lies_beside_its_photograph(place: str, name: str, tmp_path: Path) -> None:
    (tmp_path / place).mkdir(parents=True)
    photo, mask = tmp_path / "images/a.jpg", tmp_path / place / name
    assert mask_beside(photo) is None
    mask.write_bytes(b"")
    assert mask_beside(photo) == mask
    assert mask_beside(tmp_path / f"{'a' * 300}.jpg") is None  # no file can have the name of its mask
    assert mask_beside(mask) is None


def test_a_mask_has_the_shape_of_the_photograph_as_it_is_shown(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # stored lying on its side
    Image.new("RGB", (90, 120), "white").save(tmp_path / "a.jpg", exif=exif)
    shown = np.ones((45, 60), bool)
    shown[:, :20] = False
    mask = write_mask(tmp_path / "masks/a.png", shown)
    photo = Photo(tmp_path / "a.jpg", "a.jpg", LENS, np.eye(4), upright=True, mask=mask)
    _, _, _, (found,) = develop([photo], 120, silent)
    assert found is not None
    np.testing.assert_array_equal(found, shown.repeat(2, 0).repeat(2, 1))
    write_mask(mask, shown.T)
    with pytest.raises(InputError, match=r"a\.png: is 45x60 pixels, its photograph 120x90"):
        develop([photo], 120, silent)


def test_a_photograph_of_which_nothing_counts_is_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    names = write_photos(tmp_path, LENS, poses(2))
    mask = write_mask(tmp_path / "masks/view_1.png", np.zeros((90, 120), bool))
    photos = [Photo(tmp_path / name, name, LENS, np.eye(4)) for name in names]
    photos[1] = replace(photos[1], mask=mask)
    cameras, _, _, masks = develop(photos, 120, silent)
    assert ([camera.name for camera in cameras], masks) == (["view_0"], ())
    assert "view_1.png (its mask leaves nothing of it)" in caplog.text


def test_no_feature_is_sought_where_a_mask_is_black(tmp_path: Path) -> None:
    photos, work = tmp_path / "photos", tmp_path / "work"
    write_photos(photos, LENS.regridded(240, 180), poses(3))
    left = np.zeros((90, 120), bool)
    left[:, :60] = True
    write_mask(photos / "masks/view_1.png.png", left)
    (work / "images").mkdir(parents=True)
    assert sfm.match_photos(work, sfm.numbered(find_photos(photos)), silent) == 3
    with pycolmap.Database.open(work / "database.db") as database:
        ends = [database.read_keypoints(number)[:, 0].max() for number in (1, 2, 3)]
    assert ends[1] < 121 < min(ends[0], ends[2])


def test_masked_pixels_neither_train_nor_count() -> None:
    rng = np.random.default_rng(3)
    cameras = [
        look_at(np.array([x, 0, -3.0]), np.zeros(3), np.array([0, -1.0, 0]), (32, 24)) for x in (-1, 0, 1)
    ]
    named = tuple(replace(camera, name=f"{k}") for k, camera in enumerate(cameras))
    points, colours = rng.uniform(-1, 1, (200, 3)), rng.integers(0, 256, (200, 3), np.uint8)
    mask = np.ones((24, 32), bool)
    mask[:, 20:] = False
    images = [rng.integers(0, 256, (24, 32, 3), np.uint8) for _ in named]

    def capture(shade: int) -> Capture:
        shown = tuple(np.where(mask[..., None], image, np.uint8(shade)) for image in images)
        return Capture(named, shown, points, colours, masks=(mask,) * 3)

    config = RadianceConfig(steps=12, sh_degree=1, coarse_fraction=0.5)
    dark, bright = (train_radiance(capture(shade), config, [0, 1, 2]) for shade in (0, 255))
    np.testing.assert_array_equal(dark.means, bright.means)
    np.testing.assert_array_equal(dark.sh, bright.sh)
    assert evaluate_views(dark, capture(0), [1]) == evaluate_views(dark, capture(255), [1])
    unmasked = train_radiance(replace(capture(255), masks=()), config, [0, 1, 2])
    assert np.abs(unmasked.sh - bright.sh).max() > 1e-3
