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
    DepthSorter,
    SortBuffers,
    chosen_sorter,
    create_egl_context,
    front_to_back,
)
from langsplat_core.raster.reference import ReferenceRasterizer, colours
from langsplat_core.scene import Camera, Gaussians
from tests.support.backends import gl_state
from tests.support.scenes import random_camera, random_gaussians, random_values

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


def check_order(found: Array, depths: Array, near: float = -np.inf, far: float = np.inf) -> None:
    """Back to front, what lies between the planes alone."""
    ahead = np.flatnonzero((depths > near) & (depths <= far))
    np.testing.assert_array_equal(found, ahead[np.argsort(depths[ahead], kind="stable")][::-1])


def check_depths(
    gl: moderngl.Context, sorter: DepthSorter, depths: Array, near: float = -np.inf, far: float = np.inf
) -> None:
    means = np.pad(np.asarray(depths, float)[:, None], ((0, 0), (2, 0)))
    found = sorted_on_device(gl, sorter, means, np.array([0.0, 0.0, 1.0, 0.0]), near, far)
    check_order(found, means[:, 2], near, far)


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
def test_gaussians_beyond_near_and_far_are_not_drawn(gl, sorter, near, far):
    check_depths(gl, sorter, np.random.default_rng(1).integers(0, 9, 3000) / 8, near, far)


def test_depths_round_as_numpy_rounds_them(gl, sorter):
    """A fused multiplication and addition would part copies of a point, or turn near neighbours round."""
    rng = np.random.default_rng(3)
    means = rng.normal(size=(5000, 3)).astype(np.float32).astype(float) + 1e5
    means = np.concatenate([means, np.nextafter(means, np.inf), means])
    for _ in range(3):
        a, b, c, d = plane = rng.normal(size=4)
        depths = means[:, 0] * a + means[:, 1] * b + means[:, 2] * c + d
        check_order(sorted_on_device(gl, sorter, means, plane, -np.inf, np.inf), depths)


@pytest.mark.long
def test_a_million_points_are_sorted(gl, sorter):
    check_depths(gl, sorter, np.random.default_rng(2).normal(size=1_000_000).astype(np.float32), near=0.2)


@pytest.fixture
def both(gl, sorter):
    """The same rasterizer with either sort; skips where there are no compute shaders, as `sorter` does."""
    made = GlRasterizer(gl, "single", sort="cpu"), GlRasterizer(gl, "single", sort="device")
    yield made
    for rasterizer in made:
        rasterizer.release()


def test_images_do_not_depend_on_the_sorter(gl, both):
    first, second = random_gaussians(900, 1, sh_degree=1), random_gaussians(40, 2)
    twice = first.take(np.concatenate([np.arange(900), np.arange(900)[::-1]]))  # ties everywhere
    cases = [(first, random_camera(1)), (twice, random_camera(2)), (second, random_camera(1, distance=1.2))]
    views = [[rasterizer.view(*case) for case in cases] for rasterizer in both]
    for _ in range(2):  # in turn: each scene is uploaded and sorted again
        for cpu, device in zip(*views, strict=True):
            values = random_values(len(cpu.gaussians), 4)
            for got, want in zip(device.splat(values), cpu.splat(values), strict=True):
                np.testing.assert_array_equal(got, want)
            np.testing.assert_array_equal(device.depth(), cpu.depth())
            assert device.depth_at(20, 15) == cpu.depth_at(20, 15)


def test_a_scene_before_the_near_plane_draws_nothing(gl, both):
    nothing_ahead = replace(INRIA, near=1e6)
    for rasterizer in both:
        view = rasterizer.view(random_gaussians(30), random_camera(), nothing_ahead)
        assert not np.any(view.splat(np.ones((30, 1)))[1])


def test_one_order_serves_images_of_every_size(gl, both):
    gaussians, camera = random_gaussians(50), random_camera()
    for rasterizer in both:
        for case in ((camera,), (camera.resized(20, 20),), (camera, GSPLAT), (random_camera(3),)):
            fresh = GlRasterizer(gl, "single", sort="cpu")
            want = fresh.view(gaussians, *case).splat(random_values(50, 1))[0]
            got = rasterizer.view(gaussians, *case).splat(random_values(50, 1))[0]
            np.testing.assert_array_equal(got, want)
            fresh.release()


def refuse(*_: object) -> None:
    raise moderngl.Error("GLSL Compiler failed")


@pytest.mark.parametrize(
    ("of", "name", "made"),
    [
        (SortBuffers, "order", lambda b: np.arange(b.count, dtype=np.int32)),
        (moderngl.Context, "compute_shader", refuse),
    ],
)
def test_a_driver_that_fails_at_sorting_is_not_used(gl, monkeypatch, of, name, made):
    monkeypatch.setattr(of, name, made)
    with pytest.raises(BackendError, match="cannot sort"):
        GlRasterizer(gl, sort="device")


@pytest.mark.parametrize("software", [True, False])
def test_numpy_sorts_on_a_software_driver(gl, sorter, monkeypatch, software):
    monkeypatch.setattr(scene_textures, "is_software", lambda _: software)
    found = chosen_sorter(gl, "auto")
    assert (found is None) == software
    if found is not None:
        found.release()


def test_scenes_beyond_the_drivers_buffers_are_sorted_by_numpy(gl, both, monkeypatch):
    monkeypatch.setattr(DepthSorter, "holds", lambda *_: False)
    monkeypatch.setattr(DepthSorter, "sort", refuse)
    images = [one.view(random_gaussians(20), random_camera()).splat(np.ones((20, 1)))[1] for one in both]
    np.testing.assert_array_equal(*images)
    assert images[0].any()


# The OpenGL rasterizer against the float64 reference.

# Without the two cut-offs the image is a smooth function of its inputs, and float32 follows float64
# closely. What the cut-offs add is tested apart, because there single pixels may flip.
SMOOTH = replace(INRIA, transmittance_min=0.0, alpha_min=1e-6)
SINGLE = 5e-6  # measured 2e-6 at most


@pytest.fixture(scope="module")
def raster(gl_rasterizers):
    return gl_rasterizers["single"]


def agree(
    raster: GlRasterizer,
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings = SMOOTH,
    channels: int = 4,
) -> None:
    """Image, alpha and expected depth within `SINGLE` (depth: relative, where anything is seen)."""
    values = random_values(len(gaussians), channels, seed=5)
    reference = ReferenceRasterizer().view(gaussians, camera, settings)
    view = raster.view(gaussians, camera, settings)
    want, want_alpha = reference.splat(values)
    image, alpha = view.splat(values)
    assert image.shape == want.shape
    np.testing.assert_allclose(image, want, atol=SINGLE)
    np.testing.assert_allclose(alpha, want_alpha, atol=SINGLE)
    seen = want_alpha > 0.01
    np.testing.assert_allclose(view.depth()[seen], reference.depth()[seen], rtol=SINGLE)
    assert view.dropped == reference.dropped


NEAR = random_gaussians(60, scale_range=(0.01, 0.03)), random_camera(distance=0.3)
AGREEING = [
    *(
        (random_gaussians(100, seed), random_camera(seed, distance=distance))
        for seed in range(4)
        for distance in (3.0, 1.2)  # 1.2: in the middle of the scene
    ),
    (random_gaussians(100, scale_range=(1e-3, 0.05)), random_camera(), replace(SMOOTH, antialiased=True)),
    (*NEAR, replace(GSPLAT, transmittance_min=0.0, alpha_min=1e-6)),
    *(
        (random_gaussians(80, radius=2.0), replace(random_camera(distance=2.0), cx=cx, cy=cy))
        for cx, cy in ((0.0, 0.0), (-40.0, 100.0), (70.0, 22.0))
    ),
]


@pytest.mark.parametrize("case", AGREEING)
def test_images_equal_the_reference(gl, raster, case):
    agree(raster, *case)


@pytest.mark.parametrize("channels", [0, 1, 3, 4, 12, 13, 26])
def test_any_number_of_channels_is_splatted(gl, raster, channels):
    agree(raster, random_gaussians(40), random_camera(), channels=channels)


def test_gsplats_profile_draws_what_is_nearer(gl, raster):
    inria, gsplat = (len(raster.project(raster.view(*NEAR, some)).texels()) for some in (INRIA, GSPLAT))
    assert gsplat > inria


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
from langsplat_core.raster.opengl.scene_textures import chosen_sorter, create_egl_context
from tests.support.scenes import random_camera, random_gaussians, random_values
ctx = create_egl_context()
assert ctx.version_code == 410, ctx.version_code
g, c, v = random_gaussians(80, sh_degree=3), random_camera(), random_values(80, 7)
image, _ = GlRasterizer(ctx, "single").view(g, c).splat(v)
want, _ = ReferenceRasterizer().view(g, c).splat(v)
print(np.abs(image - want).max() <= 1 / 255, chosen_sorter(ctx, "auto"), ctx.error)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Mesa's override")
def test_opengl_4_1_is_enough_and_sorts_with_numpy(gl):
    if "llvmpipe" not in gl.info["GL_RENDERER"]:
        pytest.skip("only Mesa can pretend to be an older OpenGL")
    older = {"MESA_GL_VERSION_OVERRIDE": "4.1FC", "MESA_GLSL_VERSION_OVERRIDE": "410"}
    run = subprocess.run([sys.executable, "-c", MAC], env=os.environ | older, capture_output=True, text=True)
    assert run.stdout.split() == ["True", "None", "GL_NO_ERROR"], run.stderr


def test_a_missing_driver_is_reported_in_one_line(monkeypatch):
    def fail(**_):
        raise Exception("libEGL.so not loaded")

    monkeypatch.setattr("moderngl.create_context", fail)
    with pytest.raises(BackendError, match="libgl1-mesa-dri"):
        create_egl_context()
