"""The rasterizers of graphics devices.

OpenGL against the reference; the CUDA backend over the twin of gsplat, which the slow tier runs on all tests.
"""

import os
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from langsplat_core.arrays import Array
from langsplat_core.config import GSPLAT, INRIA, RadianceConfig
from langsplat_core.errors import BackendError
from langsplat_core.raster import gsplat, load_lifting_rasterizer, load_rasterizer
from langsplat_core.raster.opengl.rasterizer import create_egl_context
from langsplat_core.raster.reference import ReferenceRasterizer, colours
from langsplat_core.scene import Camera
from langsplat_core.training.radiance.differentiable import (
    CpuRenderer,
    CudaRenderer,
    DifferentiableRenderer,
    evaluate_views,
)
from langsplat_core.training.radiance.state import PARAMETERS, start
from langsplat_core.training.radiance.trainer import train_radiance
from tests.support.backends import drawn_settings
from tests.support.scenes import (
    capture,
    find_mask_weights,
    make_views,
    random_camera,
    random_gaussians,
    random_values,
    without_perspective,
)

# Without the two cut-offs the image is a smooth function of its inputs, and float32 follows float64
# closely. What the cut-offs add is tested apart, because there single pixels may flip.
SMOOTH = replace(INRIA, transmittance_min=0.0, alpha_min=1e-6)
SINGLE = 5e-6  # measured 2e-6 at most


@pytest.fixture(scope="module")
def raster(gl_rasterizers):
    return gl_rasterizers["single"]


@pytest.mark.parametrize("channels", [0, 1, 3, 4, 12, 13, 26])
@pytest.mark.parametrize("distance", [3.0, 1.2])  # 1.2: in the middle of the scene
def test_images_equal_the_reference(gl, raster, channels, distance):
    """Image, alpha and expected depth within `SINGLE` (depth: relative, where anything is seen)."""
    case = random_gaussians(100, channels), random_camera(channels, distance=distance), SMOOTH
    values = random_values(100, channels, seed=5)
    reference, view = ReferenceRasterizer().view(*case), raster.view(*case)
    want, want_alpha = reference.splat(values)
    image, alpha = view.splat(values)
    assert image.shape == want.shape
    np.testing.assert_allclose(image, want, atol=SINGLE)
    np.testing.assert_allclose(alpha, want_alpha, atol=SINGLE)
    seen = want_alpha > 0.01
    np.testing.assert_allclose(view.depth()[seen], reference.depth()[seen], rtol=SINGLE)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_view_dependent_colours(gl, raster, degree):
    gaussians, camera = random_gaussians(80, sh_degree=degree), random_camera(2)
    rgb = colours(gaussians.sh, gaussians.means, camera.position)
    want, _ = ReferenceRasterizer().view(gaussians, camera, SMOOTH).splat(rgb)
    (texture,) = raster.draw(raster.view(gaussians, camera, SMOOTH), ["colour"])
    image = np.frombuffer(texture.read(), "f4").reshape(*want.shape[:2], 4)
    np.testing.assert_allclose(image[..., :3], want, atol=SINGLE)


def test_depth_does_not_suffer_from_half_precision(gl, gl_rasterizers):
    case = random_gaussians(100), random_camera(distance=1e5), SMOOTH
    reference = ReferenceRasterizer().view(*case)
    seen = reference.splat(np.zeros((100, 0)))[1] > 0.01
    depth = gl_rasterizers["half"].view(*case).depth()
    np.testing.assert_allclose(depth[seen], reference.depth()[seen], rtol=SINGLE)


def test_views_drawn_in_turn_do_not_disturb_each_other(gl, raster):
    """One set of textures serves all views; also scenes of different size, and a zoomed camera."""
    first, second = random_gaussians(70, 1), random_gaussians(40, 2)
    camera = random_camera(1)
    cases = [(first, at) for at in (camera, random_camera(5), replace(camera, fx=2 * camera.fx))]
    cases += [(first, camera, replace(INRIA, near=near)) for near in (3.0, 1e6)]  # some, and none ahead
    views = [(raster.view(*case), ReferenceRasterizer().view(*case)) for case in [*cases, (second, camera)]]
    for view, reference in 2 * views:
        values = random_values(len(view.gaussians), 3)
        np.testing.assert_allclose(view.splat(values)[0], reference.splat(values)[0], atol=1 / 255)


def test_median_depth_of_one_pixel(gl, raster):
    case = random_gaussians(120), random_camera(1), SMOOTH
    reference, view = ReferenceRasterizer().view(*case), raster.view(*case)
    _, alpha = reference.splat(np.zeros((120, 0)))
    want = np.where(reference.median_depth() > 0, reference.median_depth(), reference.depth())
    pixels = np.argwhere(np.abs(alpha - 0.5) > 1e-4)
    for row, column in np.random.default_rng(0).choice(pixels, 40, replace=False).tolist():
        depth, covered = view.depth_at(column, row)
        assert depth == pytest.approx(want[row, column], rel=1e-5)
        assert covered == pytest.approx(alpha[row, column], abs=1e-5)


def test_median_image_falls_back_to_the_mean(gl, raster):
    view = raster.view(random_gaussians(60), random_camera())
    _, alpha = view.splat(random_values(60, 1))
    np.testing.assert_array_equal(view.median_depth(), np.where(alpha >= 0.5, view.depth(), 0))


def test_an_image_beyond_the_driver_is_refused(gl, raster):
    camera = random_camera().resized(gl.info["GL_MAX_TEXTURE_SIZE"] + 1, 4)
    with pytest.raises(BackendError, match="pixels a side"):
        raster.view(random_gaussians(3), camera)


def test_a_context_of_another_thread_is_reported_in_one_line(gl_session, raster):
    with gl_session:
        pass  # and none is current afterwards
    with pytest.raises(BackendError, match="not current"):
        raster.view(random_gaussians(3), random_camera())
    with gl_session:
        assert raster.view(random_gaussians(3), random_camera()).splat(np.ones((3, 1)))[1].any()


MAC = """
import numpy as np, moderngl
from langsplat_core.raster.opengl.rasterizer import GlRasterizer
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.raster.opengl.rasterizer import create_egl_context
from tests.support.scenes import random_camera, random_gaussians, random_values
ctx = create_egl_context()
assert ctx.version_code == 410, ctx.version_code
g, c, v = random_gaussians(80, sh_degree=3), random_camera(), random_values(80, 7)
image, _ = GlRasterizer(ctx, "single").view(g, c).splat(v)
want, _ = ReferenceRasterizer().view(g, c).splat(v)
print(np.abs(image - want).max() <= 1 / 255, ctx.error)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Mesa's override")
def test_opengl_4_1_is_enough(gl):
    if "llvmpipe" not in gl.info["GL_RENDERER"]:
        pytest.skip("only Mesa can pretend to be an older OpenGL")
    older = {"MESA_GL_VERSION_OVERRIDE": "4.1FC", "MESA_GLSL_VERSION_OVERRIDE": "410"}
    run = subprocess.run([sys.executable, "-c", MAC], env=os.environ | older, capture_output=True, text=True)
    assert run.stdout.split() == ["True", "GL_NO_ERROR"], run.stderr


def test_a_missing_driver_is_reported_in_one_line(monkeypatch):
    def fail(**_):
        raise Exception("libEGL.so not loaded")

    monkeypatch.setattr("moderngl.create_context", fail)
    with pytest.raises(BackendError, match="libgl1-mesa-dri"):
        create_egl_context()


# What CUDA draws, gathers, differentiates, lifts and trains is what the reference and the CPU kernels say, by
# gsplat where there is a device, and by its twin.


@pytest.fixture(params=["twin", "device"])
def kernels(request: pytest.FixtureRequest) -> None:
    if request.param == "twin":
        request.getfixturevalue("gsplat_twin")
    elif not gsplat.has_device():
        pytest.skip("torch finds no CUDA device")


def on_cuda(test: Any) -> Any:
    return pytest.mark.long(pytest.mark.usefixtures("kernels")(test))


SETTINGS = [INRIA, GSPLAT, replace(INRIA, antialiased=True), replace(INRIA, far=3.0)]


@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("channels", [1, 3, 6, 35])  # as they are, padded, and in two chunks
@on_cuda
@pytest.mark.parametrize("orthographic", [False, True])
def test_images_of_cuda_equal_the_reference(settings, channels, orthographic):
    gaussians, camera = random_gaussians(60, channels), random_camera(channels, 41, 30)
    camera = without_perspective(camera) if orthographic else camera
    values = np.random.default_rng(0).random((60, channels))
    view = load_rasterizer("cuda").view(gaussians, camera, settings)
    reference = ReferenceRasterizer().view(gaussians, camera, drawn_settings(settings))
    clear = ~reference.cut_off_band(1e-3)
    assert clear.mean() > 0.9
    assert reference.splat(values)[1].max() > 0.5
    for got, want in zip(view.splat(values), reference.splat(values), strict=True):
        np.testing.assert_allclose(got[clear], want[clear], atol=2e-5)
    np.testing.assert_allclose(view.depth()[clear], reference.depth()[clear], rtol=2e-5)


@on_cuda
def test_gather_is_the_adjoint_and_contributions_its_sums() -> None:
    gaussians, camera = random_gaussians(60, 1), random_camera(1, 41, 30)
    view = load_lifting_rasterizer("cuda").view(gaussians, camera)
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(60, 35)).astype(np.float32), rng.normal(size=(30, 41, 35)).astype(np.float32)
    forth, back = np.sum(view.splat(x)[0].astype(float) * y), np.sum(view.gather(y).astype(float) * x)
    assert forth == pytest.approx(back, rel=1e-5)
    sums = view.gather(np.ones((30, 41, 1), np.float32))[:, 0]
    np.testing.assert_allclose(view.contributions(), sums, rtol=1e-6)  # sums by atomics differ between runs
    assert sums.max() > 1


@on_cuda
def test_masks_lift_on_cuda_as_on_the_cpu() -> None:
    gaussians, views = random_gaussians(25, 3), make_views()
    settings = drawn_settings(INRIA)
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
    (drawn.image * torch.tensor(image_grad, device=renderer.device)).sum().add(drawn.alpha.sum()).backward()
    found: dict[str, Any] = {name: state.values[name].grad for name in PARAMETERS}
    found |= {"image": drawn.image.detach(), "visible": drawn.visible, "means_px": drawn.means_px_grad()}
    return {name: value.cpu().numpy() for name, value in found.items() if value is not None}


@on_cuda
@pytest.mark.parametrize(("degree", "orthographic"), [(0, False), (1, False), (3, False), (0, True)])
@pytest.mark.parametrize("antialiased", [False, True])
def test_gradients_of_cuda_equal_the_cpus(degree: int, orthographic: bool, antialiased: bool) -> None:
    """Those through the directions of view too; a picture in which nothing lies at a cut-off."""
    settings = replace(drawn_settings(INRIA), antialiased=antialiased)
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


@on_cuda
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


@pytest.mark.long
@pytest.mark.usefixtures("gsplat_twin")
def test_a_failing_kernel_is_reported_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(**_: object) -> None:
        raise RuntimeError("Error building extension 'gsplat_cuda'\nand a thousand lines")

    monkeypatch.setattr("gsplat.rasterization", broken)
    with pytest.raises(BackendError, match=r"Error building extension 'gsplat_cuda'\); install"):
        gsplat.require_device()
