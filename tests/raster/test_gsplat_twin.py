"""The CUDA backend's own code, and gsplat's above it, over the twin of gsplat's kernels: what is drawn,
gathered, differentiated, lifted and trained is what the reference and the CPU kernels say. The slow tier runs
the twin on all tests of rasterizers."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from langsplat_core.arrays import Array
from langsplat_core.config import GSPLAT, INRIA, RadianceConfig, RasterSettings
from langsplat_core.datasets.capture import Capture
from langsplat_core.errors import BackendError
from langsplat_core.raster import gsplat, load_lifting_rasterizer, load_rasterizer
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.scene import Camera
from langsplat_core.training.language.mask_weights import find_mask_weights
from langsplat_core.training.radiance.differentiable import (
    CpuRenderer,
    CudaRenderer,
    DifferentiableRenderer,
    evaluate_views,
)
from langsplat_core.training.radiance.state import PARAMETERS, start
from langsplat_core.training.radiance.trainer import train_radiance
from tests.support import gsplat_twin as twin
from tests.support.scenes import make_views, random_camera, random_gaussians, without_perspective

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("gsplat_twin")]

SETTINGS = [INRIA, GSPLAT, replace(INRIA, antialiased=True), replace(INRIA, far=3.0)]


@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("channels", [1, 3, 6, 35])  # as they are, padded, and in two chunks
@pytest.mark.parametrize("orthographic", [False, True])
def test_images_of_cuda_equal_the_reference(
    settings: RasterSettings, channels: int, orthographic: bool
) -> None:
    gaussians, camera = random_gaussians(60, channels), random_camera(channels, 41, 30)
    camera = without_perspective(camera) if orthographic else camera
    values = np.random.default_rng(0).random((60, channels))
    view = load_rasterizer("cuda").view(gaussians, camera, settings)
    reference = ReferenceRasterizer().view(gaussians, camera, gsplat.drawn_settings(settings))
    clear = ~reference.cut_off_band(1e-3)
    assert clear.mean() > 0.9
    assert reference.splat(values)[1].max() > 0.5
    for got, want in zip(view.splat(values), reference.splat(values), strict=True):
        np.testing.assert_allclose(got[clear], want[clear], atol=2e-5)
    np.testing.assert_allclose(view.depth()[clear], reference.depth()[clear], rtol=1e-3)


def test_gather_is_the_adjoint_and_contributions_its_sums() -> None:
    gaussians, camera = random_gaussians(60, 1), random_camera(1, 41, 30)
    view = load_lifting_rasterizer("cuda").view(gaussians, camera)
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(60, 35)).astype(np.float32), rng.normal(size=(30, 41, 35)).astype(np.float32)
    forth, back = np.sum(view.splat(x)[0].astype(float) * y), np.sum(view.gather(y).astype(float) * x)
    assert forth == pytest.approx(back, rel=1e-5)
    sums = view.gather(np.ones((30, 41, 1), np.float32))[:, 0]
    np.testing.assert_array_equal(view.contributions(), sums)
    assert sums.max() > 1


def test_masks_lift_on_cuda_as_on_the_cpu() -> None:
    gaussians, views = random_gaussians(25, 3), make_views()
    settings = gsplat.drawn_settings(INRIA)
    on = {name: load_lifting_rasterizer(name) for name in ("cpu", "cuda")}
    found = [find_mask_weights(rasterizer, gaussians, views, settings).pairs for rasterizer in on.values()]
    for cpu, cuda in zip(*found, strict=True):
        assert len(cpu) > 50
        np.testing.assert_array_equal(cpu[["row", "mask", "level"]], cuda[["row", "mask", "level"]])
        np.testing.assert_allclose(cpu["weight"], cuda["weight"], rtol=1e-4, atol=1e-5)


def gradients(
    renderer: DifferentiableRenderer, degree: int, image_grad: Array, camera: Camera
) -> dict[str, Array]:
    """Of <picture, image_grad> + the sum of alpha, by every parameter and by the projected means."""
    state = start(random_gaussians(60, 5, degree), 0, renderer.device)
    drawn = renderer.render(state.values, camera, degree)
    (drawn.image * torch.tensor(image_grad)).sum().add(drawn.alpha.sum()).backward()
    found: dict[str, Any] = {name: state.values[name].grad for name in PARAMETERS}
    found |= {"image": drawn.image.detach(), "visible": drawn.visible, "means_px": drawn.means_px_grad()}
    return {name: value.numpy() for name, value in found.items() if value is not None}


@pytest.mark.parametrize(("degree", "orthographic"), [(0, False), (1, False), (3, False), (0, True)])
@pytest.mark.parametrize("antialiased", [False, True])
def test_gradients_of_cuda_equal_the_cpus(degree: int, orthographic: bool, antialiased: bool) -> None:
    """Those through the directions of view too; a picture in which nothing lies at a cut-off."""
    settings = replace(gsplat.drawn_settings(INRIA), antialiased=antialiased)
    camera = random_camera(5, 41, 30)
    camera = without_perspective(camera) if orthographic else camera
    reference = ReferenceRasterizer().view(random_gaussians(60, 5), camera, settings)
    image_grad = np.random.default_rng(1).normal(size=(30, 41, 3)).astype(np.float32)
    assert reference.cut_off_band(1e-4).mean() < 0.05
    cpu = gradients(CpuRenderer(settings), degree, image_grad, camera)
    cuda = gradients(CudaRenderer(settings), degree, image_grad, camera)
    assert cpu.keys() == cuda.keys()
    np.testing.assert_array_equal(cuda.pop("visible")[cpu.pop("visible")], True)
    for name, want in cpu.items():
        np.testing.assert_allclose(cuda[name], want, atol=1e-4 * np.abs(want).max(), err_msg=name)


def capture() -> Capture:
    """Six pictures of a random scene, its centres as points."""
    truth = random_gaussians(60, 7)
    cameras = tuple(random_camera(seed, 40, 32) for seed in range(6))
    values = np.random.default_rng(2).random((60, 3))
    pictures = [ReferenceRasterizer().view(truth, camera).splat(values)[0] for camera in cameras]
    images = tuple(np.round(255 * picture.clip(0, 1)).astype(np.uint8) for picture in pictures)
    return Capture(cameras, images, truth.means.astype(np.float64), np.full((60, 3), 128, np.uint8))


def test_training_on_cuda_ends_where_the_cpu_does() -> None:
    config = RadianceConfig(
        steps=12, reference_steps=12, sh_degree=1, sh_degree_every=5, densify_from=3, densify_until=10,
        densify_every=4, max_gaussians=1_200,
    )  # fmt: skip
    photographs, scores = capture(), []
    for backend in ("cpu", "cuda"):
        found = train_radiance(photographs, replace(config, backend=backend), [0, 1, 2, 3, 4])
        assert len(found) > 100
        scores.append(evaluate_views(found, photographs, [5], backend)[0].psnr)
    assert scores[0] == pytest.approx(scores[1], abs=0.3)
    assert min(scores) > 10


def test_a_failing_kernel_is_reported_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("Error building extension 'gsplat_cuda'\nand a thousand lines")

    monkeypatch.setattr(twin, "intersect_tile", broken)
    with pytest.raises(BackendError, match=r"Error building extension 'gsplat_cuda'\); install") as caught:
        gsplat.require_device()
    assert "\n" not in str(caught.value)
