"""The sort in compute shaders against NumPy's stable one, and the pictures drawn in its order."""

import os
import subprocess
import sys
from dataclasses import replace

import moderngl
import numpy as np
import pytest

from langsplat_core.arrays import Array
from langsplat_core.config import GSPLAT, INRIA, RasterSettings
from langsplat_core.errors import BackendError
from langsplat_core.raster.opengl import scene_textures
from langsplat_core.raster.opengl.rasterizer import GlRasterizer
from langsplat_core.raster.opengl.scene_textures import (
    CpuOrder,
    DepthSorter,
    DeviceOrder,
    SortBuffers,
    chosen_sorter,
    create_egl_context,
    front_to_back,
    working_sorter,
)
from langsplat_core.raster.reference import ReferenceRasterizer, colours
from langsplat_core.scene import Camera, Gaussians
from tests.support.backends import gl_state
from tests.support.scenes import random_camera, random_gaussians, random_values

FORWARD = np.array([0.0, 0.0, 1.0, 0.0])
RNG = np.random.default_rng(0)
TILE = scene_textures.GROUP * scene_textures.ROUNDS
BIG, TINY = 3.4e38, 1e-45  # near the ends of float32; the latter is denormal


@pytest.fixture(scope="module")
def sorter(gl_session):
    if gl_session.version_code < 430:
        pytest.skip("no compute shaders")
    with gl_session:
        made = DepthSorter(gl_session)
    yield made
    with gl_session:
        made.release()


def sorted_on_device(
    gl: moderngl.Context, sorter: DepthSorter, means: Array, plane: Array, near: float, far: float
) -> Array:
    rows = gl.buffer(reserve=4 * max(len(means), 1))
    buffers = SortBuffers(gl, means, rows)
    for _ in range(2):  # what the first left behind must not matter
        sorter.sort(buffers, plane, near, far)
    found = buffers.order()
    buffers.release()
    rows.release()
    return found


def back_to_front(depths: Array, near: float, far: float) -> Array:
    ahead = np.flatnonzero((depths > near) & (depths <= far))
    return ahead[np.argsort(depths[ahead], kind="stable")][::-1]


def check_depths(
    gl: moderngl.Context, sorter: DepthSorter, depths: Array, near: float = -np.inf, far: float = np.inf
) -> None:
    means = np.zeros((len(depths), 3))
    means[:, 2] = depths
    found = sorted_on_device(gl, sorter, means, FORWARD, near, far)
    np.testing.assert_array_equal(found, back_to_front(np.asarray(depths, float), near, far))


DEPTHS = {
    **{f"{n} points": RNG.uniform(size=n) for n in (0, 1, 255, 256, 257, TILE - 1, TILE, TILE + 1)},
    "two": [1.0, 2.0],
    "two the other way": [2.0, 1.0],
    "all equal": np.full(TILE + 3, 0.7),
    "ascending": np.arange(TILE + 1.0),
    "descending": np.arange(TILE - 1.0)[::-1],
    "many ties": RNG.integers(0, 7, 3 * TILE + 5).astype(float),
    "ties far apart": np.tile(RNG.uniform(size=TILE), 3),
    "last bit alone differs": 1 + np.spacing(1.0) * RNG.integers(0, 500, 1000),
    "negative": RNG.normal(size=1500),
    "zeros of both signs": np.tile([0.0, -0.0, 1.0, -1.0], 80),
    "denormal": TINY * RNG.integers(-9, 9, 700),
    "infinite and not a number": np.tile([np.inf, -np.inf, np.nan, 3.0, -3.0, BIG, -BIG], 60),
    "all magnitudes": np.sign(RNG.normal(size=2500)) * 10.0 ** RNG.uniform(-300, 300, 2500),
}


@pytest.mark.parametrize("name", DEPTHS)
def test_order_is_that_of_a_stable_sort(gl, sorter, name):
    check_depths(gl, sorter, np.asarray(DEPTHS[name]))


@pytest.mark.parametrize(
    ("near", "far"), [(0.2, np.inf), (0.5, 0.75), (0.5, 0.5), (2.0, np.inf), (-1.0, 0.25)]
)
def test_what_is_cut_away_is_not_drawn(gl, sorter, near, far):
    check_depths(gl, sorter, np.random.default_rng(1).integers(0, 9, 3000) / 8, near, far)


def test_depths_round_as_numpy_rounds_them(gl, sorter):
    """A fused multiplication and addition would part copies of a point, or turn near neighbours round."""
    rng = np.random.default_rng(3)
    means = rng.normal(size=(5000, 3)).astype(np.float32).astype(float) + 1e5
    means = np.concatenate([means, np.nextafter(means, np.inf), means])
    for _ in range(3):
        a, b, c, d = plane = rng.normal(size=4)
        depths = means[:, 0] * a + means[:, 1] * b + means[:, 2] * c + d
        found = sorted_on_device(gl, sorter, means, plane, -np.inf, np.inf)
        np.testing.assert_array_equal(found, back_to_front(depths, -np.inf, np.inf))


@pytest.mark.long
def test_a_million_points(gl, sorter):
    check_depths(gl, sorter, np.random.default_rng(2).normal(size=1_000_000).astype(np.float32), near=0.2)


@pytest.fixture
def both(gl, sorter):
    """The same rasterizer with either sort; skips where there are no compute shaders, as `sorter` does."""
    made = GlRasterizer(gl, "single", sort="cpu"), GlRasterizer(gl, "single", sort="device")
    yield made
    for rasterizer in made:
        rasterizer.release()


def test_pictures_do_not_depend_on_who_sorts(gl, both):
    first, second = random_gaussians(900, 1, sh_degree=1), random_gaussians(40, 2)
    twice = first.take(np.concatenate([np.arange(900), np.arange(900)[::-1]]))  # ties everywhere
    cases = [(first, random_camera(1)), (twice, random_camera(2)), (second, random_camera(1, distance=1.2))]
    views = [[rasterizer.view(*case) for case in cases] for rasterizer in both]
    for _ in range(2):  # in turn: each scene is uploaded and sorted again
        for cpu, device in zip(*views, strict=True):
            assert (type(cpu.order), type(device.order)) == (CpuOrder, DeviceOrder)
            values = random_values(len(cpu.gaussians), 4)
            for got, want in zip(device.splat(values), cpu.splat(values), strict=True):
                np.testing.assert_array_equal(got, want)
            np.testing.assert_array_equal(device.depth(), cpu.depth())
            assert device.depth_at(20, 15) == cpu.depth_at(20, 15)


def test_a_scene_before_the_near_plane_draws_nothing(gl, both):
    nothing_ahead = replace(INRIA, near=1e6)
    for rasterizer in both:
        image, alpha = rasterizer.view(random_gaussians(30), random_camera(), nothing_ahead).splat(
            np.ones((30, 1))
        )
        assert not image.any()
        assert not alpha.any()


def test_the_order_is_kept_while_the_camera_stands(gl, both):
    _, rasterizer = both
    gaussians, camera = random_gaussians(50), random_camera()
    view = rasterizer.view(gaussians, camera)
    view.splat(random_values(50, 1))
    assert rasterizer.view(gaussians, camera.resized(20, 20)).order is view.order
    assert rasterizer.view(gaussians, random_camera(3)).order is not view.order
    assert rasterizer.view(gaussians, camera, GSPLAT).order is not view.order


def test_a_driver_that_sorts_wrongly_is_not_used(gl, monkeypatch):
    monkeypatch.setattr(SortBuffers, "order", lambda self: np.arange(self.count, dtype=np.int32))
    assert working_sorter(gl) is None
    with pytest.raises(BackendError, match="cannot sort"):
        GlRasterizer(gl, sort="device")


def test_a_driver_that_cannot_compile_it_is_not_used(gl, monkeypatch):
    def refuse(*_):
        raise moderngl.Error("GLSL Compiler failed")

    monkeypatch.setattr(DepthSorter, "__init__", refuse)
    assert working_sorter(gl) is None


@pytest.mark.parametrize("software", [True, False])
def test_a_software_driver_leaves_it_to_numpy(gl, sorter, monkeypatch, software):
    monkeypatch.setattr(scene_textures, "is_software", lambda _: software)
    found = chosen_sorter(gl, "auto")
    assert (found is None) == software
    if found is not None:
        found.release()


def test_scenes_beyond_the_drivers_buffers_are_sorted_by_numpy(gl, both, monkeypatch):
    _, rasterizer = both
    monkeypatch.setattr(DepthSorter, "holds", lambda *_: False)
    view = rasterizer.view(random_gaussians(20), random_camera())
    assert isinstance(view.order, CpuOrder)
    assert view.splat(np.ones((20, 1)))[1].any()


# The OpenGL rasterizer against the float64 reference.

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
from langsplat_core.raster.opengl.scene_textures import create_egl_context, working_sorter
from tests.support.scenes import random_camera, random_gaussians, random_values
ctx = create_egl_context()
assert ctx.version_code == 410, ctx.version_code
g, c, v = random_gaussians(80, sh_degree=3), random_camera(), random_values(80, 7)
image, _ = GlRasterizer(ctx, "single").view(g, c).splat(v)
want, _ = ReferenceRasterizer().view(g, c).splat(v)
print(np.abs(image - want).max() <= 1 / 255, working_sorter(ctx), ctx.error)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Mesa's override")
def test_opengl_4_1_is_enough_and_sorts_with_numpy(gl):
    if "llvmpipe" not in gl.info["GL_RENDERER"]:
        pytest.skip("only Mesa can pretend to be an older OpenGL")
    older = {"MESA_GL_VERSION_OVERRIDE": "4.1FC", "MESA_GLSL_VERSION_OVERRIDE": "410"}
    run = subprocess.run([sys.executable, "-c", MAC], env=os.environ | older, capture_output=True, text=True)
    assert run.stdout.split() == ["True", "None", "GL_NO_ERROR"], run.stderr


def test_an_absent_driver_is_one_line(monkeypatch):
    def fail(**_):
        raise Exception("libEGL.so not loaded")

    monkeypatch.setattr("moderngl.create_context", fail)
    with pytest.raises(BackendError, match="libgl1-mesa-dri"):
        create_egl_context()
