"""Lenses, their inverses, and the pictures made from them."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from PIL import Image

from langsplat_core.arrays import Array
from langsplat_core.datasets.colmap import LENSES, lens_of
from langsplat_core.datasets.intrinsics import (
    BrownDistortion,
    FisheyeDistortion,
    PhotoIntrinsics,
    pinhole_for,
    resample,
    source_positions,
    undistorted_points,
)
from langsplat_core.errors import InputError
from tests.support.photographs import photograph, pinhole_picture, poses, psnr

pytestmark = pytest.mark.long

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
    assert intrinsics.distortion is not None
    grid = np.stack(
        np.meshgrid(np.linspace(0, intrinsics.width, 33), np.linspace(0, intrinsics.height, 25)), -1
    )
    pixels = grid.reshape(-1, 2)
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


@pytest.mark.parametrize(
    "intrinsics", [PHONE, BARREL, FISHEYE, PhotoIntrinsics(640, 480, 500.0, 490.0, 310.0, 250.0)]
)
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
    folding = PhotoIntrinsics(
        640, 480, 300.0, 300.0, 320.0, 240.0, BrownDistortion(-0.4)
    )  # folds at radius 0.91
    camera = pinhole_for(folding, 2000)
    corner = np.hypot(camera.cx / camera.fx, camera.cy / camera.fy)
    assert 0.5 < corner < 0.92
    assert source_positions(folding, camera).min() >= 0


@pytest.mark.parametrize("k1", [np.nan, 1e300, -1e12])
def test_an_impossible_lens_is_refused_in_one_line(k1: float) -> None:
    intrinsics = PhotoIntrinsics(640, 480, 300.0, 300.0, 320.0, 240.0, BrownDistortion(k1))
    with pytest.raises(InputError) as caught:
        pinhole_for(intrinsics, 800)
    assert "\n" not in str(caught.value)
