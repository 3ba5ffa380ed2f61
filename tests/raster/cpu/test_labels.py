"""Lifting label maps is ``W^T onehot(labels)``, and says so wherever labels lie."""

import numpy as np
import pytest
from scipy import sparse

from langsplat_core.arrays import Array
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.raster.protocol import LiftingRasterizer
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.scene import Gaussians
from tests.support.scenes import random_camera, random_gaussians

CPU = CpuRasterizer()
SIZES = [(70, 45), (64, 48), (1, 1), (17, 33)]  # multiples of a tile's side, and not


def onehot(maps: Array, count: int) -> Array:
    """(H, W, count): 1 where a pixel has the label in any map."""
    return np.stack([(maps == label).any(0) for label in range(count)], -1).astype(np.float64)


def dense(gaussians: Gaussians, camera: object, maps: Array, count: int) -> Array:
    """(N, count) by the float64 reference."""
    return ReferenceRasterizer().view(gaussians, camera).gather(onehot(maps, count))  # type: ignore[arg-type]


@pytest.mark.parametrize("rasterizer", [CPU, ReferenceRasterizer()], ids=["in one walk", "label by label"])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("count", [1, 5, 90])
def test_weights_are_those_of_the_reference(
    size: tuple[int, int], count: int, rasterizer: LiftingRasterizer
) -> None:
    gaussians, camera = random_gaussians(60, 3), random_camera(1, *size)
    rng = np.random.default_rng(count)
    maps = rng.integers(-1, count, (3, size[1], size[0])).astype(np.int32)
    got = rasterizer.view(gaussians, camera).gather_labels(maps, count)
    want = dense(gaussians, camera, maps, count)
    assert got.shape == want.shape
    assert got.has_sorted_indices
    np.testing.assert_allclose(got.toarray(), want, atol=1e-5 * max(want.max(), 1))
    assert (got.data > 0).all()


def test_every_pixel_with_a_label_of_its_own():
    """The most that a tile can meet: 256 regions a level."""
    gaussians, camera = random_gaussians(30, 4), random_camera(2, 32, 16)
    maps = np.arange(2 * 16 * 32, dtype=np.int32).reshape(2, 16, 32)
    got = CPU.view(gaussians, camera).gather_labels(maps, 1024)
    np.testing.assert_allclose(got.toarray(), dense(gaussians, camera, maps, 1024), atol=1e-6)


def test_no_labels_no_gaussians_and_none_in_sight():
    gaussians, camera = random_gaussians(20, 5), random_camera(3, 40, 30)
    nothing = np.full((3, 30, 40), -1, np.int32)
    assert CPU.view(gaussians, camera).gather_labels(nothing, 4).nnz == 0
    assert CPU.view(gaussians, camera).gather_labels(nothing, 0).shape == (20, 0)
    some = np.zeros((1, 30, 40), np.int32)
    assert CPU.view(gaussians.take(slice(0)), camera).gather_labels(some, 1).shape == (0, 1)
    behind = Gaussians(
        gaussians.means + 1e4 * camera.position, *(vars(gaussians)[n] for n in list(vars(gaussians))[1:])
    )
    assert CPU.view(behind, camera).gather_labels(some, 1).nnz == 0


def test_light_pairs_are_left_out_and_rows_stay_in_place():
    gaussians, camera = random_gaussians(80, 6), random_camera(4)
    broken = gaussians.take(np.arange(80))
    broken.means[7] = np.nan
    maps = np.random.default_rng(0).integers(-1, 6, (3, 45, 70)).astype(np.int32)
    whole = CPU.view(broken, camera).gather_labels(maps, 6)
    assert whole[7].nnz == 0
    some = CPU.view(broken, camera).gather_labels(maps, 6, 0.5)
    kept = sparse.csr_matrix(np.where(whole.toarray() > 0.5, whole.toarray(), 0))
    assert 0 < some.nnz < whole.nnz
    assert (abs(some - kept) > 0).nnz == 0


def test_results_do_not_depend_on_threads():
    gaussians, camera = random_gaussians(300, 7), random_camera(5, 120, 90)
    maps = np.random.default_rng(1).integers(-1, 40, (3, 90, 120)).astype(np.int32)
    one, many = (CpuRasterizer(n).view(gaussians, camera).gather_labels(maps, 40) for n in (1, 4))
    for name in ("data", "indices", "indptr"):
        np.testing.assert_array_equal(getattr(one, name), getattr(many, name))


@pytest.mark.parametrize("label", [-2, 3])
def test_labels_out_of_range_are_refused(label: int) -> None:
    maps = np.zeros((1, 45, 70), np.int32)
    maps[0, 3, 3] = label
    for rasterizer in (CPU, ReferenceRasterizer()):
        view = rasterizer.view(random_gaussians(3), random_camera())
        with pytest.raises(ValueError, match="expected -1 to 2"):
            view.gather_labels(maps, 3)
        with pytest.raises(ValueError, match="maps: expected shape"):
            view.gather_labels(maps[:, :5], 3)
