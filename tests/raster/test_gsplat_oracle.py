"""A second opinion on projection, covariance and colours: gsplat's plain PyTorch functions, on the CPU.

They were written by others from the same papers. gsplat's own rasterizer needs CUDA; these do not.
"""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.arrays import Array, rotation_matrices
from langsplat_core.config import GSPLAT
from langsplat_core.raster import reference
from langsplat_core.raster.cpu import projection as cpu_colour
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.raster.reference import project
from langsplat_core.scene import Camera, Gaussians
from tests.support.scenes import random_camera, random_gaussians

torch = pytest.importorskip("torch")
oracle = pytest.importorskip("gsplat.cuda._torch_impl")
# gsplat publishes its plain twin under private names only
covariance_and_precision = oracle._quat_scale_to_covar_preci  # noqa: SLF001  see above
fused_projection = oracle._fully_fused_projection  # noqa: SLF001  see above
spherical_harmonics_of_gsplat = oracle._spherical_harmonics  # noqa: SLF001  see above


def double(array: Array) -> "torch.Tensor":
    return torch.tensor(np.asarray(array, np.float64))


def gsplat_projection(gaussians: Gaussians, camera: Camera) -> tuple[Array, ...]:
    """gsplat's radii, means2d, depths, conics and compensations, in float64."""
    quats = torch.nn.functional.normalize(double(gaussians.quats_wxyz), dim=1)
    covariances, _ = covariance_and_precision(quats, double(gaussians.log_scales).exp())
    intrinsics = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    found = fused_projection(
        double(gaussians.means), covariances, double(camera.world_to_camera)[None], double(intrinsics)[None],
        camera.width, camera.height, eps2d=GSPLAT.dilation, near_plane=GSPLAT.near, calc_compensations=True,
    )  # fmt: skip
    return tuple(part[0].numpy() for part in found)


def scenes() -> list[tuple[Gaussians, Camera]]:
    """Before the camera, around it, with the principal point off centre; sharp and blurred."""
    return [
        (
            random_gaussians(300, seed, scale_range=(0.002, 0.3)),
            random_camera(seed, 70, 45, distance=distance),
        )
        for seed, distance in enumerate((3.0, 3.0, 1.2, 0.5, 8.0))
    ]


@pytest.mark.parametrize(("gaussians", "camera"), scenes())
def test_projection(gaussians: Gaussians, camera: Camera) -> None:
    _, means_px, depths, conics, compensations = gsplat_projection(gaussians, camera)
    ours = project(gaussians, camera, GSPLAT)
    drawn = depths > GSPLAT.near
    assert drawn.sum() > 100
    np.testing.assert_array_equal(ours.opacities[~drawn], 0)
    np.testing.assert_allclose(ours.depths[drawn], depths[drawn], rtol=1e-12)
    np.testing.assert_allclose(ours.means_px[drawn], means_px[drawn], rtol=1e-10, atol=1e-9)
    # gsplat forms the 3D covariance first and so loses digits where a footprint is long and thin.
    np.testing.assert_allclose(ours.conics[drawn], conics[drawn], rtol=1e-6, atol=1e-9)
    sharp = project(gaussians, camera, replace(GSPLAT, antialiased=True))
    both = drawn & (sharp.opacities > 0)
    floored = np.maximum(compensations, 0.005)  # as INRIA's code floors it; gsplat 1.5.3 does not
    np.testing.assert_allclose(sharp.opacities[both] / ours.opacities[both], floored[both], rtol=1e-5)


@pytest.mark.parametrize(("gaussians", "camera"), scenes())
def test_no_radius_of_the_cpu_kernels_is_larger_than_gsplats(gaussians: Gaussians, camera: Camera) -> None:
    """gsplat bounds a footprint by 3.33 standard deviations, opacity 1 at alpha 1/255; ours is exact."""
    radii = CpuRasterizer().view(gaussians, camera, GSPLAT).radii
    theirs = gsplat_projection(gaussians, camera)[0].max(1)
    assert (radii > 0).sum() > 10
    assert (radii <= theirs + 1e-3).all()


@pytest.mark.parametrize("degree", range(4))
def test_spherical_harmonics(degree: int) -> None:
    """float64 to 1e-6 (gsplat types its constants to 7 to 16 digits), the compiled float32 twin to 2e-6."""
    gaussians, eye = random_gaussians(300, 7, degree), np.array([0.4, -2.5, 0.7])
    gaussians = replace(gaussians, sh=2.5 * gaussians.sh)
    directions = double(gaussians.means.astype(np.float64) - eye)
    want = spherical_harmonics_of_gsplat(degree, directions, double(gaussians.sh)).numpy() + 0.5
    want = np.maximum(want, 0)
    assert (want == 0).any()
    ours = reference.colours(gaussians.sh, gaussians.means, eye)
    np.testing.assert_allclose(ours, want, atol=1e-6)
    np.testing.assert_allclose(cpu_colour.colours(gaussians.sh, gaussians.means, eye), want, atol=2e-6)


def test_covariance() -> None:
    gaussians = random_gaussians(200, 8, scale_range=(1e-4, 1.0))
    quats = torch.nn.functional.normalize(double(gaussians.quats_wxyz), dim=1)
    want, precision = covariance_and_precision(quats, double(gaussians.log_scales).exp())
    scales = np.exp(gaussians.log_scales.astype(np.float64))
    half = rotation_matrices(gaussians.quats_wxyz.astype(np.float64)) * scales[:, None, :]
    ours = half @ half.transpose(0, 2, 1)
    np.testing.assert_allclose(ours, want.numpy(), rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(ours @ precision.numpy(), np.broadcast_to(np.eye(3), ours.shape), atol=1e-5)
