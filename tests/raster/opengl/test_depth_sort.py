"""The sort in compute shaders against NumPy's stable one, and the pictures drawn in its order."""

import os
import subprocess
import sys
from dataclasses import replace

import moderngl
import numpy as np
import pytest

from langsplat_core.arrays import Array
from langsplat_core.config import INRIA
from langsplat_core.errors import BackendError
from langsplat_core.raster.opengl import scene_textures
from langsplat_core.raster.opengl.rasterizer import GlRasterizer
from langsplat_core.raster.opengl.scene_textures import (
    CpuOrder,
    DepthSorter,
    DeviceOrder,
    SortBuffers,
    chosen_sorter,
    working_sorter,
)
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
    "one": [1.0],
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


@pytest.mark.parametrize("count", [0, 1, 255, 256, 257, TILE - 1, TILE, TILE + 1])
def test_any_number_of_points(gl, sorter, count):
    check_depths(gl, sorter, np.random.default_rng(count).uniform(size=count))


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
def both(gl):
    """The same rasterizer with either sort."""
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
def test_a_software_driver_leaves_it_to_numpy(gl, monkeypatch, software):
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


OLDER = """
from langsplat_core.raster.opengl.scene_textures import create_egl_context
from langsplat_core.raster.opengl.scene_textures import working_sorter
ctx = create_egl_context()
print(ctx.version_code, working_sorter(ctx), ctx.error)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Mesa's override")
def test_opengl_4_1_sorts_with_numpy(gl):
    if "llvmpipe" not in gl.info["GL_RENDERER"]:
        pytest.skip("only Mesa can pretend to be an older OpenGL")
    older = {"MESA_GL_VERSION_OVERRIDE": "4.1FC", "MESA_GLSL_VERSION_OVERRIDE": "410"}
    run = subprocess.run(
        [sys.executable, "-c", OLDER], env=os.environ | older, capture_output=True, text=True
    )
    assert run.stdout.split() == ["410", "None", "GL_NO_ERROR"], run.stderr
