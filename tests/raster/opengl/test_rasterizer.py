"""The OpenGL rasterizer against the float64 reference."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.config import GSPLAT, INRIA, RasterSettings
from langsplat_core.errors import BackendError
from langsplat_core.raster.opengl.rasterizer import GlRasterizer
from langsplat_core.raster.opengl.scene_textures import create_egl_context, front_to_back
from langsplat_core.raster.reference import ReferenceRasterizer, colours
from langsplat_core.scene import Camera, Gaussians
from tests.support.gl_context import gl_state
from tests.support.scenes import random_camera, random_gaussians, random_values

# Without the two cut-offs the image is a smooth function of its inputs, and float32 follows float64
# closely. What the cut-offs add is tested apart, because there single pixels may flip.
SMOOTH = replace(INRIA, transmittance_min=0.0, alpha_min=1e-6)
SINGLE = 5e-6  # measured 2e-6 at most
NEEDLES = 1e-4  # measured 3e-5: a pixel centre's distance from a million pixels' axis, in float32


@pytest.fixture(scope="module")
def raster(gl_session):
    with gl_session:
        rasterizer = GlRasterizer(gl_session, "single", sort="cpu")
    yield rasterizer
    with gl_session:
        rasterizer.release()


def agree(
    raster: GlRasterizer,
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings = SMOOTH,
    tolerance: float = SINGLE,
) -> None:
    """Image, alpha and expected depth within `tolerance` (depth: relative, where anything is seen)."""
    values = random_values(len(gaussians), 4, seed=5)
    reference = ReferenceRasterizer().view(gaussians, camera, settings)
    view = raster.view(gaussians, camera, settings)
    want, want_alpha = reference.splat(values)
    image, alpha = view.splat(values)
    np.testing.assert_allclose(image, want, atol=tolerance)
    np.testing.assert_allclose(alpha, want_alpha, atol=tolerance)
    seen = want_alpha > 0.01
    np.testing.assert_allclose(view.depth()[seen], reference.depth()[seen], rtol=tolerance)
    assert view.dropped == reference.dropped


@pytest.mark.usefixtures("gl")
class TestAgainstTheReference:
    @pytest.mark.parametrize("seed", range(4))
    @pytest.mark.parametrize("distance", [3.0, 1.2])  # 1.2: in the middle of the scene
    def test_random_scenes(self, raster, seed, distance):
        agree(raster, random_gaussians(100, seed), random_camera(seed, distance=distance))

    def test_antialiased(self, raster):
        settings = replace(SMOOTH, antialiased=True)
        agree(raster, random_gaussians(100, scale_range=(1e-3, 0.05)), random_camera(), settings)

    def test_gsplat_profile_draws_what_is_nearer(self, raster):
        gaussians = random_gaussians(60, scale_range=(0.01, 0.03))
        camera = random_camera(distance=0.3)
        agree(raster, gaussians, camera, replace(GSPLAT, transmittance_min=0.0, alpha_min=1e-6))
        inria, gsplat = (raster.view(gaussians, camera, s) for s in (INRIA, GSPLAT))
        assert len(gsplat.order.texels) > len(inria.order.texels)

    @pytest.mark.parametrize("centre", [(0.0, 0.0), (-40.0, 100.0), (70.0, 22.0)])
    def test_principal_point_anywhere(self, raster, centre):
        camera = replace(random_camera(distance=2.0), cx=centre[0], cy=centre[1])
        agree(raster, random_gaussians(80, radius=2.0), camera)

    @pytest.mark.parametrize("channels", [0, 1, 3, 4, 12, 13, 26])
    def test_any_number_of_channels(self, raster, channels):
        gaussians, camera = random_gaussians(40), random_camera()
        values = random_values(40, channels)
        want, want_alpha = ReferenceRasterizer().view(gaussians, camera, SMOOTH).splat(values)
        image, alpha = raster.view(gaussians, camera, SMOOTH).splat(values)
        assert image.shape == want.shape
        np.testing.assert_allclose(image, want, atol=SINGLE)
        np.testing.assert_allclose(alpha, want_alpha, atol=SINGLE)

    @pytest.mark.parametrize("degree", [0, 1, 2, 3])
    def test_view_dependent_colours(self, raster, degree):
        gaussians, camera = random_gaussians(80, sh_degree=degree), random_camera(2)
        rgb = colours(gaussians.sh, gaussians.means, camera.position)
        want, _ = ReferenceRasterizer().view(gaussians, camera, SMOOTH).splat(rgb)
        (texture,) = raster.draw(raster.view(gaussians, camera, SMOOTH), ["colour"])
        image = np.frombuffer(texture.read(), "f4").reshape(*want.shape[:2], 4)
        np.testing.assert_allclose(image[..., :3], want, atol=SINGLE)

    def test_copies_of_a_gaussian_are_drawn_by_index(self, raster):
        """From any direction: equal rows must get equal depths, wherever in the file they are."""
        twice = random_gaussians(41).take(np.concatenate([np.arange(41), np.arange(41)[::-1]]))
        for seed in range(3):
            agree(raster, twice, random_camera(seed))


def test_depth_does_not_suffer_from_half_precision(gl):
    raster = GlRasterizer(gl, "half")
    gaussians, camera = random_gaussians(100), random_camera(distance=1e5)
    agree_depth = ReferenceRasterizer().view(gaussians, camera, SMOOTH)
    _, alpha = agree_depth.splat(np.zeros((100, 0)))
    depth = raster.view(gaussians, camera, SMOOTH).depth()
    np.testing.assert_allclose(depth[alpha > 0.01], agree_depth.depth()[alpha > 0.01], rtol=SINGLE)
    raster.release()


def test_at_the_cut_offs_few_pixels_flip_and_none_by_much(gl, raster):
    """Blending has no early stop (T <= 1e-4 costs 1e-4 of a value), and an alpha within rounding of 1/255
    may fall on either side (which costs one alpha of 1/255)."""
    flipped = total = 0
    for seed in range(6):
        gaussians, camera = random_gaussians(150, seed), random_camera(seed, distance=2.0)
        values = random_values(150, 3, seed)
        image, _ = raster.view(gaussians, camera).splat(values)
        want, _ = ReferenceRasterizer().view(gaussians, camera).splat(values)
        error = np.abs(image - want).max(-1)
        assert error.max() <= 1 / 255
        flipped += int((error > 2e-4).sum())
        total += error.size
    assert flipped <= 1e-3 * total


def test_a_footprint_ends_where_alpha_is_one_255th(gl, raster):
    """A lone Gaussian: exactly the pixels of the reference, so the quad cuts none and adds none."""
    for seed in range(8):
        gaussians, camera = random_gaussians(1, seed, scale_range=(0.01, 1.5)), random_camera(seed)
        _, alpha = raster.view(gaussians, camera).splat(np.zeros((1, 0)))
        _, want = ReferenceRasterizer().view(gaussians, camera).splat(np.zeros((1, 0)))
        borderline = np.abs(want * 255 - 1) < 1e-3
        np.testing.assert_array_equal((alpha > 0)[~borderline], (want > 0)[~borderline])


def test_views_drawn_in_turn_do_not_disturb_each_other(gl, raster):
    """One set of textures serves all views; also scenes of different size, and a zoomed camera."""
    first, second = random_gaussians(70, 1), random_gaussians(40, 2)
    camera = random_camera(1)
    cases = [
        (first, camera),
        (first, random_camera(5)),
        (first, replace(camera, fx=2 * camera.fx)),
        (second, camera),
    ]
    views = [raster.view(*case) for case in cases]
    for _ in range(2):
        for view, (gaussians, cam) in zip(views, cases, strict=True):
            values = random_values(len(gaussians), 3)
            want, _ = ReferenceRasterizer().view(gaussians, cam).splat(values)
            np.testing.assert_allclose(view.splat(values)[0], want, atol=1 / 255)


def test_the_order_is_kept_while_the_camera_stands(gl, raster):
    gaussians, camera = random_gaussians(50), random_camera()
    view = raster.view(gaussians, camera)
    view.splat(random_values(50, 1))
    assert raster.view(gaussians, camera.resized(20, 20)).order is view.order
    assert raster.view(gaussians, random_camera(3)).order is not view.order
    assert raster.view(gaussians, camera, GSPLAT).order is not view.order


def test_median_depth_of_one_pixel(gl, raster):
    gaussians, camera = random_gaussians(120), random_camera(1)
    reference = ReferenceRasterizer().view(gaussians, camera, SMOOTH)
    view = raster.view(gaussians, camera, SMOOTH)
    median, mean = reference.median_depth(), reference.depth()
    _, alpha = reference.splat(np.zeros((120, 0)))
    want = np.where(median > 0, median, mean)
    rows, columns = np.nonzero(np.abs(alpha - 0.5) > 1e-4)
    for i in np.random.default_rng(0).choice(len(rows), 40, replace=False):
        row, column = int(rows[i]), int(columns[i])
        depth, covered = view.depth_at(column, row)
        assert depth == pytest.approx(want[row, column], rel=1e-5)
        assert covered == pytest.approx(alpha[row, column], abs=1e-5)


def test_in_place_of_a_median_image_stands_the_mean_where_half_is_stopped(gl, raster):
    view = raster.view(random_gaussians(60), random_camera())
    _, alpha = view.splat(random_values(60, 1))
    np.testing.assert_array_equal(view.median_depth(), np.where(alpha >= 0.5, view.depth(), 0))


def test_an_image_beyond_the_driver_is_refused(gl, raster):
    camera = random_camera().resized(gl.info["GL_MAX_TEXTURE_SIZE"] + 1, 4)
    with pytest.raises(BackendError, match="pixels a side"):
        raster.view(random_gaussians(3), camera)


def test_a_context_that_is_not_current_is_one_line(gl_session, raster):
    with gl_session:
        pass  # and none is current afterwards
    with pytest.raises(BackendError, match="not current"):
        raster.view(random_gaussians(3), random_camera())
    with gl_session:
        assert raster.view(random_gaussians(3), random_camera()).splat(np.ones((3, 1)))[1].any()


def test_front_to_back_is_stable():
    rng = np.random.default_rng(0)
    for depths in (rng.integers(0, 9, 500).astype(float), rng.uniform(size=500), np.zeros(7), np.zeros(0)):
        np.testing.assert_array_equal(front_to_back(depths), np.argsort(depths, kind="stable"))


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="asks libGL.so.1")
def test_the_state_of_gl_is_left_as_found(gl, raster):
    target = gl.framebuffer([gl.texture((30, 20), 4)])
    target.viewport = (3, 4, 10, 11)
    target.use()
    gl.enable_only(0)
    gl.blend_func = 0x0302, 0x0303  # source alpha, 1 - source alpha
    before = gl_state()
    view = raster.view(random_gaussians(20), random_camera())
    view.splat(random_values(20, 7))
    view.depth()
    np.testing.assert_array_equal(gl_state(), before)
    assert before[-4:].all()  # colour masks open
    gl.detect_framebuffer(0).use()
    target.release()


MAC = """
import numpy as np, moderngl
from langsplat_core.raster.opengl.rasterizer import GlRasterizer
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.raster.opengl.scene_textures import create_egl_context
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


def test_an_absent_driver_is_one_line(monkeypatch):
    def fail(**_):
        raise Exception("libEGL.so not loaded")

    monkeypatch.setattr("moderngl.create_context", fail)
    with pytest.raises(BackendError, match="libgl1-mesa-dri"):
        create_egl_context()
