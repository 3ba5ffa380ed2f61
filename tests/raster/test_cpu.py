"""The CPU rasterizer against the float64 reference, and laws that need none."""

import tracemalloc
from dataclasses import fields, replace

import numpy as np
import pytest
from scipy import sparse

from langsplat_core.arrays import Array
from langsplat_core.config import GSPLAT, INRIA
from langsplat_core.raster import reference
from langsplat_core.raster.cpu.projection import HALF_WIDTH, colours, colours_backward
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer, Memory
from langsplat_core.raster.cpu.tiles import depth_order
from langsplat_core.raster.protocol import LiftingRasterizer
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.scene import Camera
from tests.support.backends import BAND, assert_close_off_cuts, assert_gradient, reference_gradients
from tests.support.scenes import random_camera, random_gaussians, random_values, without_perspective

CPU, REFERENCE = CpuRasterizer(), ReferenceRasterizer()
PLAIN = Camera(40, 30, 40.0, 40.0, 20.0, 15.0, np.eye(4))  # at the origin, looking along z


@pytest.mark.parametrize("channels", [0, 1, 2, 5, 32, 40])
@pytest.mark.parametrize("distance", [0.6, 3.0])  # 0.6: in the scene, Gaussians behind, beside and around
@pytest.mark.parametrize("settings", [INRIA, GSPLAT])
def test_images_equal_the_reference(channels, distance, settings):
    gaussians, camera = random_gaussians(150, 8 + channels), random_camera(8, distance=distance)
    x = random_values(len(gaussians), channels)
    fast, slow = CPU.view(gaussians, camera, settings), REFERENCE.view(gaussians, camera, settings)
    band = slow.cut_off_band(BAND)
    (image, alpha), (want, want_alpha) = fast.splat(x), slow.splat(x)
    assert image.dtype == alpha.dtype == np.float32
    assert_close_off_cuts(np.dstack([image, alpha]), np.dstack([want, want_alpha]), band, 2e-5)
    y = np.random.default_rng(1).normal(size=image.shape).astype(np.float32)
    y[band] = 0  # flipped weights of the band would enter every sum
    np.testing.assert_allclose(fast.gather(y), slow.gather(y), atol=1e-5 * max(image.size, 100) ** 0.5)
    halves = np.abs(fast.median_depth() - slow.median_depth()) > 1e-5 * max(slow.depth().max(), 1)
    assert halves.sum() <= 1 + band.sum()  # T of exactly 0.5 is one more step
    assert (fast.median_rows() != slow.median_rows()).sum() <= 1 + band.sum()
    assert alpha.max() > 0.1


def test_drawn_gaussians_have_the_footprints_of_the_reference():
    gaussians, camera = random_gaussians(300, 18, radius=2.0), random_camera(18)
    view = CPU.view(gaussians, camera)
    extents = REFERENCE.view(gaussians, camera).footprints.extents_px[view.order]
    drawn = view.gather(np.ones((camera.height, camera.width, 1)))[:, 0] > 0
    assert 0 < drawn.sum() < 300
    assert view.drawn[drawn].all()
    assert (view.drawn & ~drawn).mean() < 0.05  # hidden ones only
    np.testing.assert_allclose(view.tiles.geometry[:, HALF_WIDTH:], extents, rtol=1e-12)
    sizes, opacities = np.geomspace(1e-30, 1e6, 900).reshape(300, 3), np.linspace(-5.5, 40, 300)
    extreme = replace(gaussians, log_scales=np.log(sizes), opacity_logits=opacities)
    view = CPU.view(extreme, camera)
    extents = REFERENCE.view(extreme, camera).footprints.extents_px[view.order]
    assert len(extents) > 100
    np.testing.assert_allclose(view.tiles.geometry[:, HALF_WIDTH:], extents, rtol=1e-12)


def test_arrays_of_any_type_and_layout_are_taken():
    """Doubles, strided and read-only arrays (as memory-mapped files give) mean the same."""
    gaussians, camera = random_gaussians(50, 26), random_camera(26)
    x = random_values(50, 3)
    view = CPU.view(gaussians, camera)
    want, y = view.splat(x)[0], np.ones((45, 70, 2), np.float32)
    assert np.array_equal(view.splat(np.asfortranarray(x.astype(np.float64)))[0], want)
    flipped = np.asfortranarray(y.astype(np.float64))
    assert np.array_equal(view.gather(flipped), view.gather(y))
    for field in fields(gaussians):
        getattr(gaussians, field.name).flags.writeable = False
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
    assert touched <= len(CPU.view(gaussians, camera).tiles.met) <= 1.15 * touched


def test_memory_is_used_again_once_nothing_lies_in_it():
    memory = Memory()
    first = memory.empty((50_000, 4), np.float64)
    part, place = first[3:9].view(np.uint64), first.ctypes.data
    del first
    second = memory.empty((50_000, 4), np.float64)
    assert not np.shares_memory(second, part)
    del part
    assert memory.empty((40_000, 4), np.float64).ctypes.data == place


def test_memory_that_nobody_asks_for_is_given_back():
    memory = Memory()
    tracemalloc.start()
    memory.empty((1_000_000,), np.float64)
    for _ in range(100):
        memory.empty((50,), np.float64)
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 1e6


def test_depth_order_is_a_stable_sort():
    rng = np.random.default_rng(21)
    for depths in (
        rng.integers(1, 5, 500).astype(float),
        rng.lognormal(0, 9, 500),
        np.ones(0),
        np.append(1 + 1e-14 * rng.random(5000), 1e300),  # a plane, nearly, and a floater
    ):
        rows = np.flatnonzero(rng.random(len(depths)) < 0.7).astype(np.int32)
        found = depth_order(depths, rows, CPU.workers)
        assert np.array_equal(found, rows[np.argsort(depths[rows], kind="stable")])


@pytest.mark.parametrize("degree", range(4))
def test_colours_and_gradients_equal_the_reference(degree):
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


def test_wrong_shapes_and_numbers_are_named():
    view = CPU.view(random_gaussians(5), PLAIN)
    for blend, shape in ((view.splat, (5, 3)), (view.gather, (30, 40, 3))):
        with pytest.raises(ValueError, match="some are not finite"):
            blend(np.full(shape, np.nan))
    with pytest.raises(ValueError, match="values: expected shape"):
        view.splat(np.zeros((4, 3), np.float32))
    with pytest.raises(ValueError, match="image: expected shape"):
        view.gather(np.zeros((40, 30, 3), np.float32))
    with pytest.raises(ValueError, match="image_grad: expected shape"):
        view.backward(np.zeros((5, 3), np.float32), np.zeros((30, 40, 2), np.float32))
    with pytest.raises(ValueError, match="alpha_grad: expected shape"):
        view.backward(np.zeros((5, 3), np.float32), np.zeros((30, 40, 3)), np.zeros((40, 30)))


# Lifting label maps is ``W^T onehot(labels)``, and says so wherever labels lie.


def label_maps(count: int, width: int = 70, height: int = 45) -> Array:
    """Return (3, height, width) int32 labels from -1, none, to `count` - 1."""
    return np.random.default_rng(count).integers(-1, count, (3, height, width)).astype(np.int32)


MAPS = [
    *(label_maps(count, *size) for count in (1, 5, 90) for size in ((70, 45), (64, 48), (1, 1), (17, 33))),
    np.arange(2 * 16 * 32, dtype=np.int32).reshape(2, 16, 32),  # the most that a tile can meet: 256 a level
]


@pytest.mark.parametrize("rasterizer", [CPU, REFERENCE], ids=["in one walk", "label by label"])
@pytest.mark.parametrize("maps", MAPS)
def test_label_weights_equal_the_reference(maps: Array, rasterizer: LiftingRasterizer) -> None:
    count = int(maps.max()) + 1
    gaussians, camera = random_gaussians(60, 3), random_camera(1, maps.shape[2], maps.shape[1])
    got = rasterizer.view(gaussians, camera).gather_labels(maps, count)
    onehot = np.stack([(maps == label).any(0) for label in range(count)], -1).astype(np.float64)
    want = REFERENCE.view(gaussians, camera).gather(onehot)
    assert got.shape == want.shape
    assert got.has_sorted_indices
    np.testing.assert_allclose(got.toarray(), want, atol=1e-5 * max(want.max(), 1))
    assert (got.data > 0).all()


def test_empty_labels_and_scenes_have_no_weights():
    gaussians, camera = random_gaussians(20, 5), random_camera(3)
    view, some = CPU.view(gaussians, camera), label_maps(1)
    assert view.gather_labels(some * 0 - 1, 4).nnz == 0
    assert view.gather_labels(some * 0 - 1, 0).shape == (20, 0)
    assert CPU.view(gaussians.take(slice(0)), camera).gather_labels(some, 1).shape == (0, 1)
    behind = replace(gaussians, means=gaussians.means + 1e4 * camera.position)
    assert CPU.view(behind, camera).gather_labels(some, 1).nnz == 0


def test_small_weights_are_left_out_and_rows_keep_their_place():
    broken, camera, maps = random_gaussians(80, 6), random_camera(4), label_maps(6)
    broken.means[7] = np.nan
    whole = CPU.view(broken, camera).gather_labels(maps, 6)
    assert whole[7].nnz == 0
    some = CPU.view(broken, camera).gather_labels(maps, 6, 0.5)
    kept = sparse.csr_matrix(np.where(whole.toarray() > 0.5, whole.toarray(), 0))
    assert 0 < some.nnz < whole.nnz
    assert (abs(some - kept) > 0).nnz == 0


@pytest.mark.parametrize("label", [-2, 3, 0.5])
def test_labels_out_of_range_are_refused(label: float) -> None:
    maps = np.zeros((1, 45, 70), type(label))
    maps[0, 3, 3] = label
    for rasterizer in (CPU, REFERENCE):
        view = rasterizer.view(random_gaussians(3), random_camera())
        with pytest.raises(ValueError, match="expected whole numbers from -1 to 2"):
            view.gather_labels(maps, 3)
        with pytest.raises(ValueError, match="maps: expected shape"):
            view.gather_labels(maps[:, :5], 3)


# Gradients of the CPU rasterizer against differences of the reference.


def assert_gradients(gaussians, camera, settings=INRIA, channels=3, rows=None):
    """1e-3 relative for every entry of the gradients of `rows`; pixels at a cut-off carry no loss."""
    x = random_values(len(gaussians), channels, 1)
    rng = np.random.default_rng(2)
    image_grad = rng.normal(size=(camera.height, camera.width, channels))
    alpha_grad = rng.normal(size=(camera.height, camera.width))
    band = REFERENCE.view(gaussians, camera, settings).cut_off_band(BAND)
    assert band.mean() < 0.02
    image_grad[band], alpha_grad[band] = 0, 0
    got = CPU.view(gaussians, camera, settings).backward(x, image_grad, alpha_grad)
    rows = rng.permutation(len(gaussians))[:6] if rows is None else rows
    wanted = reference_gradients(gaussians, camera, settings, x, image_grad, alpha_grad, rows)
    for name, want in wanted.items():
        assert_gradient(name, getattr(got, name)[rows], want, largest=np.abs(getattr(got, name)).max())
    return got


@pytest.mark.long
@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("seed", range(10))
def test_gradients_are_slopes_of_the_reference(seed, orthographic):
    """Some antialiased, of gsplat's profile, opaque, smaller than photographs; of 1, 3 and 5 channels."""
    gaussians = random_gaussians(40, seed, scale_range=(0.003, 0.1) if seed % 2 else (0.02, 0.25))
    if seed % 5 == 0:
        gaussians = replace(gaussians, opacity_logits=gaussians.opacity_logits + np.float32(3))
    settings = replace(GSPLAT if seed % 3 == 0 else INRIA, antialiased=bool(seed % 2))
    camera = random_camera(seed, 32, 22)
    settings = replace(settings, focal=None if seed % 4 else 3 * camera.fx)
    camera = without_perspective(camera) if orthographic else camera
    got = assert_gradients(gaussians, camera, settings, 1 + 2 * (seed % 4 % 3))
    assert (got.opacity_logits != 0).sum() > 15


@pytest.mark.parametrize("antialiased", [False, True])
def test_clamped_coordinates_have_no_gradient(antialiased):
    """Large Gaussians beside the field of view: none is clamped, and depth changes nothing but the order."""
    settings = replace(INRIA, antialiased=antialiased)
    gaussians, camera = random_gaussians(50, 3, radius=2.0), random_camera(3, 40, 27, distance=1.5)
    in_camera = gaussians.means @ camera.rotation.T + camera.world_to_camera[:3, 3]
    aside = (np.abs(in_camera[:, 0] / in_camera[:, 2]) > 1.0) & (in_camera[:, 2] > 0.2)
    got = assert_gradients(gaussians, camera, settings, rows=np.flatnonzero(aside)[:8])
    assert (aside & (got.means != 0).any(1)).sum() >= 3
    got = assert_gradients(gaussians, without_perspective(camera, 1.5), settings)
    np.testing.assert_allclose(got.means @ camera.rotation[2], 0, atol=1e-5 * np.abs(got.means).max())


def test_gradients_of_opaque_needles_and_discs():
    gaussians = random_gaussians(50, 5)
    log_scales, logits = gaussians.log_scales.copy(), gaussians.opacity_logits.copy()
    log_scales[:20] = np.log([0.6, 1e-5, 1e-5])
    log_scales[20:30, 0] = -np.inf
    logits[::3] = 9.0  # alpha is capped in the middle: no gradient there
    changed = replace(gaussians, log_scales=log_scales, opacity_logits=logits)
    got = assert_gradients(changed, random_camera(5, 40, 27), rows=np.arange(0, 50, 6))
    assert not got.log_scales[20:30, 0].any()
