"""The front door: one call from a scene and a camera to a picture."""

import doctest
import subprocess
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import langsplat_core
from langsplat_core import Scene, render
from langsplat_core.config import GSPLAT, INRIA
from langsplat_core.errors import BackendError, InputError
from langsplat_core.io.cameras import read_cameras, write_cameras
from langsplat_core.raster import load_lifting_rasterizer, load_rasterizer, protocol, reference
from langsplat_core.raster import render as front_door
from langsplat_core.raster.render import pixel_weights, splat_colours, view_of
from langsplat_core.scene import look_at
from tests.support.scenes import random_camera, random_gaussians, random_values, without_perspective

G, CAMERA = random_gaussians(80, 4, sh_degree=2), random_camera(2)
either = pytest.mark.parametrize("backend", ["cpu", "reference"])


def test_backends_are_loaded_lazily():
    code = "import sys, langsplat_core.raster; print({'numba', 'torch', 'moderngl'} & {*sys.modules})"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "set()\n"


def test_the_example_in_the_docstring_runs():
    result = doctest.testmod(front_door)
    assert (result.attempted, result.failed) == (6, 0)


@either
def test_render_projects_colours_and_splats(backend: str) -> None:
    values = random_values(80, 2)
    picture = render(Scene(G), CAMERA, values, backend=backend)
    view = load_rasterizer("reference").view(G, CAMERA)
    colours = reference.colours(G.sh, G.means, CAMERA.position)
    want, alpha = view.splat(np.concatenate([colours, values], 1))
    np.testing.assert_allclose(picture.colours, want[..., :3], atol=2e-5)
    np.testing.assert_allclose(picture.values, want[..., 3:], atol=2e-5)
    np.testing.assert_allclose(picture.alpha, alpha, atol=2e-5)
    assert render(Scene(G), CAMERA, backend=backend).values.shape == (*alpha.shape, 0)


def test_the_scenes_antialiasing_and_the_profile_apply():
    raster = load_rasterizer("cpu")
    settings = Scene(G, antialiased=True).raster_settings(GSPLAT)
    assert settings.antialiased
    assert settings.near == GSPLAT.near
    want = splat_colours(raster.view(G, CAMERA, settings), G)
    got = render(Scene(G, antialiased=True), CAMERA, profile=GSPLAT)
    np.testing.assert_array_equal(got.colours, want.colours)
    assert not np.array_equal(got.colours, render(Scene(G), CAMERA).colours)


@either
def test_larger_images_show_what_photographs_showed(backend: str) -> None:
    """Gaussians thinner than a pixel are all dilation: an image four times as large has as much of it."""
    thin = replace(
        G, log_scales=np.full_like(G.log_scales, -9.0), sh=G.sh[:, :1], opacity_logits=G.opacity_logits + 9
    )
    large = CAMERA.resized(4 * CAMERA.width, 4 * CAMERA.height)
    fitted = Scene(thin, cameras=(CAMERA, CAMERA, CAMERA.resized(20, 15)))
    assert fitted.raster_settings().focal == pytest.approx(np.sqrt(CAMERA.fx * CAMERA.fy))
    small = render(fitted, CAMERA, backend=backend)
    np.testing.assert_array_equal(small.alpha, render(Scene(thin), CAMERA, backend=backend).alpha)
    alike = render(fitted, large, backend=backend).alpha.mean()
    assert alike == pytest.approx(small.alpha.mean(), rel=0.01)
    assert render(Scene(thin), large, backend=backend).alpha.mean() < 0.1 * small.alpha.mean()
    flat = without_perspective(large)  # its pixels have no focal length
    without = render(Scene(thin), flat, backend=backend).alpha
    np.testing.assert_array_equal(render(fitted, flat, backend=backend).alpha, without)
    less = CAMERA.resized(CAMERA.width // 2, CAMERA.height // 2)
    assert protocol.dilation(less, fitted.raster_settings()) == INRIA.dilation  # it guards against aliasing


@pytest.mark.parametrize("factor", [1e-30, 1e-3, 0.1])
def test_impossible_focal_lengths_do_not_dilate(factor: float) -> None:
    wrong = replace(CAMERA, fx=CAMERA.fx * factor, fy=CAMERA.fy * factor)
    assert Scene(G, cameras=(wrong,)).raster_settings().focal is None
    settings = replace(INRIA, focal=wrong.fx)
    assert protocol.dilation(CAMERA, settings) <= protocol.MOST_GROWTH * INRIA.dilation


@either
def test_a_view_is_formed_as_the_scene_was_trained(backend):
    """Antialiasing and the focal length that dilation follows; settings that are given take their place."""
    fitted = Scene(G, cameras=(CAMERA,), antialiased=True)
    camera, x = CAMERA.resized(3 * CAMERA.width, 3 * CAMERA.height), random_values(len(G), 2)
    rasterizer = load_lifting_rasterizer(backend)
    own = replace(INRIA, antialiased=True, focal=float(np.sqrt(CAMERA.fx * CAMERA.fy)))
    for got, settings in (
        (view_of(fitted, camera, rasterizer), own),
        (view_of(fitted, camera, rasterizer, INRIA), INRIA),
    ):
        want = rasterizer.view(G, camera, settings).splat(x)[0]
        np.testing.assert_array_equal(got.splat(x)[0], want)
    drawn = render(fitted, camera, x, backend).values
    np.testing.assert_allclose(drawn, rasterizer.view(G, camera, own).splat(x)[0], atol=1e-5)
    assert np.abs(drawn - rasterizer.view(G, camera).splat(x)[0]).max() > 0.01


def test_backends_that_cannot_draw_or_lift_are_refused():
    with pytest.raises(InputError, match="choose one of reference, cpu, opengl, cuda"):
        render(Scene(G), CAMERA, backend="vulkan")
    with pytest.raises(BackendError, match="--backend cpu"):
        render(Scene(G), CAMERA, backend="cuda")
    assert load_lifting_rasterizer("auto").name in ("cpu", "cuda")
    for name, message in (("opengl", "cannot lift"), ("vulkan", "choose one of")):
        with pytest.raises(InputError, match=message):
            load_lifting_rasterizer(name)


def test_every_public_name_is_there():
    for name in langsplat_core.__all__:
        assert getattr(langsplat_core, name).__doc__
    with pytest.raises(AttributeError, match="nothing_like_it"):
        getattr(langsplat_core, "nothing_like_it")  # noqa: B009  the module's own __getattr__ is meant


def test_an_image_beyond_memory_is_refused_before_allocation(tmp_path: Path) -> None:
    write_cameras(tmp_path / "view.json", (replace(random_camera(2), width=65_536, height=65_536),))
    (camera,) = read_cameras(tmp_path / "view.json")
    tracemalloc.start()
    with pytest.raises(InputError, match="65536x65536 pixels is too large; choose a smaller size"):
        render(Scene(G), camera)
    assert tracemalloc.get_traced_memory()[1] < 1e9  # modules that are imported meanwhile, no images
    tracemalloc.stop()


# The Gaussians of one pixel are those that the whole view blends there.


def view_from(distance: float):
    return look_at(np.array([0.2, -0.3, -distance]), np.zeros(3), np.array([0.0, -1, 0]), (64, 48))


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("distance", [3.0, 0.8])  # outside, and amid them: some behind, some at the edge
@either
def test_pixel_weights_are_a_row_of_w(backend, distance, orthographic):
    gaussians = random_gaussians(400, 3, scale_range=(0.005, 0.5))
    camera, rasterizer = view_from(distance), load_lifting_rasterizer(backend)
    camera = without_perspective(camera) if orthographic else camera
    truth = load_lifting_rasterizer("reference").view(gaussians, camera)
    for column, row in [(0, 0), (63, 47), (32, 24), (20, 40), (50, 5)]:
        image = np.zeros((48, 64, 1))
        image[row, column] = 1
        rows, weights = pixel_weights(Scene(gaussians), camera, (column, row), rasterizer)
        got = np.zeros(len(gaussians))
        got[rows] = weights
        assert (weights > 0).all()
        np.testing.assert_allclose(got, truth.gather(image)[:, 0], atol=2e-5)


def test_empty_scenes_have_no_pixel_weights():
    rows, weights = pixel_weights(Scene(random_gaussians(20).take(slice(0))), view_from(3.0), (1, 1))
    assert len(rows) == len(weights) == 0
