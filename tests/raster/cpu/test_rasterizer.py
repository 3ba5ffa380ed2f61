"""The CPU rasterizer against the float64 reference, and laws that need none."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest

from langsplat_core.config import GSPLAT, INRIA
from langsplat_core.errors import BackendError, InputError
from langsplat_core.raster import BACKENDS, load_rasterizer, reference
from langsplat_core.raster.cpu.projection import colours, colours_backward
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.raster.cpu.tiles import depth_order
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.scene import Camera
from tests.support.close import BAND, assert_adjoint, assert_close_off_cuts
from tests.support.golden import load_golden
from tests.support.scenes import random_camera, random_gaussians, random_values

CPU, REFERENCE = CpuRasterizer(), ReferenceRasterizer()
PLAIN = Camera(40, 30, 40.0, 40.0, 20.0, 15.0, np.eye(4))  # at the origin, looking along z


def assert_same_picture(gaussians, camera, settings=INRIA, channels=3, atol=2e-5):
    """Splat, alpha, gather, depths of the CPU equal the reference's; returns the CPU's image."""
    x = random_values(len(gaussians), channels)
    fast, slow = CPU.view(gaussians, camera, settings), REFERENCE.view(gaussians, camera, settings)
    band = slow.cut_off_band(BAND)
    (image, alpha), (want, want_alpha) = fast.splat(x), slow.splat(x)
    assert image.dtype == alpha.dtype == np.float32
    assert_close_off_cuts(image, want, band, atol)
    assert_close_off_cuts(alpha, want_alpha, band, atol)
    y = np.random.default_rng(1).normal(size=image.shape).astype(np.float32)
    y[band] = 0  # flipped weights of the band would enter every sum
    np.testing.assert_allclose(fast.gather(y), slow.gather(y), atol=1e-5 * max(image.size, 100) ** 0.5)
    assert_adjoint(lambda v: fast.splat(v)[0], fast.gather, x, y)
    depth = slow.depth()
    assert_close_off_cuts(fast.depth(), depth, band, atol * max(depth.max(), 1))
    halves = np.abs(fast.median_depth() - slow.median_depth()) > 1e-5 * max(depth.max(), 1)
    assert halves.sum() <= 1 + band.sum()  # T of exactly 0.5 is one more step
    assert fast.dropped == slow.dropped
    return image


@pytest.mark.parametrize("seed", range(4))
def test_random_scenes(seed):
    image = assert_same_picture(random_gaussians(150, seed), random_camera(seed))
    assert image.max() > 0.1


@pytest.mark.parametrize("distance", [0.6, 1.0])
def test_inside_the_scene(distance):
    """Gaussians behind, beside and around the camera: near plane and clamped Jacobians."""
    assert_same_picture(random_gaussians(150, 8), random_camera(8, distance=distance))
    assert_same_picture(random_gaussians(150, 8), random_camera(8, distance=distance), GSPLAT)


@pytest.mark.parametrize("channels", [1, 2, 5, 32, 40])
def test_any_number_of_channels(channels):
    assert_same_picture(random_gaussians(60, 11), random_camera(11), channels=channels)


def test_contributions_are_the_summed_weights():
    gaussians, camera = random_gaussians(200, 17), random_camera(17)
    view, truth = CPU.view(gaussians, camera), REFERENCE.view(gaussians, camera)
    want = truth.gather(np.ones((camera.height, camera.width, 1)))[:, 0]
    np.testing.assert_array_equal(truth.contributions(), want)
    np.testing.assert_allclose(view.contributions(), want, atol=1e-3)  # a flipped pixel weighs up to 1/255
    assert abs(view.contributions().sum() - view.splat(np.zeros((200, 0)))[1].sum()) < 1e-2


@pytest.mark.parametrize("channels", [1, 3, 12, 40])
@pytest.mark.parametrize("size", [(70, 45), (1, 1), (33, 5)])
def test_a_frozen_view_differs_by_its_rounding_only(channels, size):
    gaussians, camera = random_gaussians(300, 21), random_camera(21, *size)
    view = CPU.view(gaussians, camera)
    frozen = view.frozen()
    x = random_values(300, channels)
    (image, alpha), (want, want_alpha) = frozen.splat(x), view.splat(x)
    np.testing.assert_array_equal(alpha, want_alpha)
    deepest = 0.5 / 65535 * 300  # every Gaussian rounded the wrong way
    assert np.abs(image - want).max(initial=0) < min(deepest, 2e-4)
    y = np.random.default_rng(3).uniform(-1, 1, image.shape).astype(np.float32)
    assert np.abs(frozen.gather(y) - view.gather(y)).max() < 0.5 / 65535 * size[0] * size[1]
    assert_adjoint(lambda v: frozen.splat(v)[0], frozen.gather, x, y)
    np.testing.assert_array_equal(frozen.depth(), view.depth())
    assert frozen.dropped == view.dropped
    assert 0 < frozen.nbytes < 40 * len(view.tiles.ranks) * 16 + 16 * size[0] * size[1] + 64


def test_a_frozen_view_of_nothing():
    empty = CPU.view(random_gaussians(0), PLAIN).frozen()
    assert not empty.splat(np.zeros((0, 3), np.float32))[0].any()
    assert empty.gather(np.zeros((30, 40, 2), np.float32)).shape == (0, 2)


def test_radii_are_positive_exactly_where_something_is_drawn():
    gaussians, camera = random_gaussians(300, 18, radius=2.0), random_camera(18)
    view = CPU.view(gaussians, camera)
    extents = REFERENCE.view(gaussians, camera).footprints.extents_px.max(1)
    drawn = view.gather(np.ones((camera.height, camera.width, 1)))[:, 0] > 0
    assert 0 < drawn.sum() < 300
    assert (view.radii[drawn] > 0).all()
    assert ((view.radii > 0) & ~drawn).mean() < 0.05  # hidden ones only
    np.testing.assert_allclose(view.radii[view.radii > 0], extents[view.radii > 0], rtol=1e-5)


def test_two_threads_may_render_at_once():
    gaussians, camera = random_gaussians(300, 25), random_camera(25, 120, 90)
    x = random_values(300, 3)
    want = CPU.view(gaussians, camera).splat(x)[0]

    def render(_: int) -> bool:
        return all(np.array_equal(CPU.view(gaussians, camera).splat(x)[0], want) for _ in range(5))

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(render, range(4)))


def test_arrays_of_any_make():
    """Doubles, strided and read-only arrays (as memory-mapped files give) mean the same."""
    gaussians, camera = random_gaussians(50, 26), random_camera(26)
    x = random_values(50, 3)
    view = CPU.view(gaussians, camera)
    want, y = view.splat(x)[0], np.ones((45, 70, 2), np.float32)
    assert np.array_equal(view.splat(np.asfortranarray(x.astype(np.float64)))[0], want)
    flipped = np.asfortranarray(y.astype(np.float64))
    assert np.array_equal(view.gather(flipped), view.gather(y))
    for name in vars(gaussians):
        getattr(gaussians, name).flags.writeable = False
    x.flags.writeable = y.flags.writeable = False
    view = CPU.view(gaussians, camera)
    assert np.array_equal(view.splat(x)[0], want)
    assert view.gather(y).any()
    assert view.backward(x[:, :2], y).means.any()
    assert colours(gaussians.sh, gaussians.means, camera.position).any()


def test_tiles_hold_little_more_than_what_touches_them():
    """Culling by the ellipse, not by its box: needles across the image are the case that counts."""
    gaussians, camera = random_gaussians(60, 20, scale_range=(0.001, 0.6)), random_camera(20, 128, 96)
    f = REFERENCE.view(gaussians, camera).footprints
    ys, xs = np.mgrid[:96, :128] + 0.5
    touched = 0
    for mean, (xx, xy, yy), opacity in zip(f.means_px, f.conics, f.opacities, strict=True):
        dx, dy = xs - mean[0], ys - mean[1]
        alpha = opacity * np.exp(-0.5 * (xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy))
        touched += (alpha.reshape(6, 16, 8, 16).max((1, 3)) >= 1 / 255).sum()
    kept = len(CPU.view(gaussians, camera).tiles.ranks)
    assert touched <= kept <= 1.15 * touched


def test_depth_order_is_a_stable_sort():
    rng = np.random.default_rng(21)
    for depths in (
        rng.integers(1, 5, 500).astype(float),
        rng.lognormal(0, 9, 500),
        np.full(3, 2.0),
        np.ones(0),
    ):
        status = rng.integers(0, 3, len(depths)).astype(np.uint8)
        drawn = np.flatnonzero(status == 2)
        want = drawn[np.argsort(depths[drawn], kind="stable")]
        assert np.array_equal(depth_order(status, depths.view(np.uint64)), want)


@pytest.mark.parametrize("case", ["tiny_case", "basic_case"])
def test_golden_images_of_gsplat(real_data, case):
    gaussians, camera, want = load_golden(real_data / "golden" / f"{case}.safetensors")
    image, alpha = CPU.view(gaussians, camera, GSPLAT).splat(
        colours(gaussians.sh, gaussians.means, camera.position)
    )
    got = np.concatenate([image, alpha[..., None]], -1)
    np.testing.assert_allclose(got, want, atol=1e-5, rtol=0.01)


@pytest.mark.parametrize("degree", range(4))
def test_colours_and_their_gradient(degree):
    gaussians, eye = random_gaussians(200, 22, degree), np.array([0.3, -2.0, 0.5])
    gaussians = replace(gaussians, sh=2 * gaussians.sh)
    sh, means = gaussians.sh.astype(np.float64), gaussians.means.astype(np.float64)
    want = reference.colours(sh, means, eye)
    np.testing.assert_allclose(colours(gaussians.sh, gaussians.means, eye), want, atol=1e-6)
    assert (want == 0).any()  # some are clamped
    grad = np.random.default_rng(0).normal(size=want.shape).astype(np.float32)
    sh_grad, means_grad = colours_backward(gaussians.sh, gaussians.means, eye, grad)

    def loss(sh, means):
        return (reference.colours(sh, means, eye) * grad).sum(1)

    step = 1e-6
    for axis in np.eye(3) * step:
        want = (loss(sh, means + axis) - loss(sh, means - axis)) / (2 * step)
        np.testing.assert_allclose(means_grad @ axis / step, want, atol=1e-6)
    for k in range(sh.shape[1]):
        for channel in range(3):
            nudge = np.zeros_like(sh)
            nudge[:, k, channel] = step
            want = (loss(sh + nudge, means) - loss(sh - nudge, means)) / (2 * step)
            np.testing.assert_allclose(sh_grad[:, k, channel], want, atol=1e-6)


def test_colours_of_invalid_and_coincident_rows():
    gaussians = random_gaussians(3, 23, 1)
    sh, means = gaussians.sh.copy(), gaussians.means.copy()
    sh[0, 1, 1], means[1] = np.nan, 0
    got = colours(sh, means, np.zeros(3))
    np.testing.assert_allclose(got, reference.colours(sh, means, np.zeros(3)), atol=1e-6)
    sh_grad, means_grad = colours_backward(sh, means, np.zeros(3), np.ones((3, 3)))
    assert np.isfinite(sh_grad).all()
    assert np.isfinite(means_grad).all()
    assert not sh_grad[0, :, 1].any()


def test_backends_are_loaded_by_name_and_lazily():
    assert set(BACKENDS) == {"reference", "cpu", "opengl", "cuda"}
    assert load_rasterizer("cpu", threads=1).name == "cpu"
    with pytest.raises(InputError, match="choose one of reference, cpu, opengl, cuda"):
        load_rasterizer("vulkan")
    code = (
        "import sys, langsplat_core.raster; "
        "print([m for m in ('numba', 'torch', 'moderngl') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"


@pytest.mark.skipif(find_spec("gsplat") is not None, reason="gsplat is installed")
def test_a_missing_backend_says_what_to_try():
    with pytest.raises(BackendError, match=r"^rasterizer 'cuda' cannot load \(.*\); try --backend cpu$"):
        load_rasterizer("cuda")


def test_no_channels_still_have_an_alpha():
    view = CPU.view(random_gaussians(30, 24), random_camera(24))
    image, alpha = view.splat(np.zeros((30, 0), np.float32))
    assert image.shape == (45, 70, 0)
    assert np.array_equal(alpha, view.splat(np.ones((30, 1), np.float32))[1])
    assert view.gather(image).shape == (30, 0)


def test_wrong_shapes_are_named():
    view = CPU.view(random_gaussians(5), PLAIN)
    with pytest.raises(ValueError, match="values: expected shape"):
        view.splat(np.zeros((4, 3), np.float32))
    with pytest.raises(ValueError, match="image: expected shape"):
        view.gather(np.zeros((40, 30, 3), np.float32))
    with pytest.raises(ValueError, match="image_grad: expected shape"):
        view.backward(np.zeros((5, 3), np.float32), np.zeros((30, 40, 2), np.float32))
    with pytest.raises(ValueError, match="alpha_grad: expected shape"):
        view.backward(np.zeros((5, 3), np.float32), np.zeros((30, 40, 3)), np.zeros((40, 30)))
