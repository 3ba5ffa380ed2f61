"""The reference against closed forms and images of gsplat; the front door against the reference."""

import doctest
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file
from scipy.spatial.transform import Rotation

import langsplat_core
from langsplat_core import Scene, render
from langsplat_core.arrays import Array
from langsplat_core.config import GSPLAT, INRIA
from langsplat_core.errors import BackendError, InputError
from langsplat_core.io.cameras import read_cameras, write_cameras
from langsplat_core.raster import load_lifting_rasterizer, load_rasterizer, protocol, reference
from langsplat_core.raster import render as front_door
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.raster.reference import ReferenceRasterizer, colours
from langsplat_core.raster.render import colours_seen, pixel_weights, view_of
from langsplat_core.scene import Camera, Gaussians, look_at
from tests.support.backends import BAND
from tests.support.hard_cases import AXIS, balls
from tests.support.scenes import (
    covariances,
    random_camera,
    random_gaussians,
    random_values,
    without_perspective,
)

RASTER = ReferenceRasterizer()


def test_one_ball_on_the_axis_is_a_gaussian_of_known_width():
    """And ends where its alpha reaches the smallest that counts."""
    view = RASTER.view(balls([3.0], [0.8]), AXIS)
    image, alpha = view.splat(np.full((1, 1), 2.5))
    variance = (30.0 * 0.2 / 3.0) ** 2 + 0.3
    reach = np.sqrt(variance * 2 * np.log(255 * 0.8))
    np.testing.assert_allclose(view.footprints.extents_px[0], reach, rtol=1e-6)
    offset = np.arange(21) + 0.5 - 10.5
    want = 0.8 * np.exp(-0.5 * (offset[:, None] ** 2 + offset**2) / variance)
    want[want < 1 / 255] = 0
    np.testing.assert_allclose(alpha, want, atol=1e-7)  # the opacity is a float32 logit
    np.testing.assert_allclose(image[..., 0], 2.5 * want, atol=3e-7)


def test_the_nearer_of_two_hides_the_farther():
    view = RASTER.view(balls([4.0, 3.0], [0.5, 0.6]), AXIS)
    image, alpha = view.splat(np.eye(2))
    np.testing.assert_allclose(image[10, 10], [0.5 * 0.4, 0.6], atol=1e-7)
    np.testing.assert_allclose(alpha[10, 10], 1 - 0.5 * 0.4, atol=1e-7)
    assert view.median_depth()[10, 10] == 3.0
    np.testing.assert_allclose(view.depth()[10, 10], (0.2 * 4 + 0.6 * 3) / 0.8, atol=1e-6)


def test_a_tilted_ellipsoid_projects_to_the_textbook_covariance():
    """Off the axis and rotated: J R S S^T R^T J^T + 0.3 I, built here without the kernel's shortcuts."""
    g = random_gaussians(1, seed=3, scale_range=(0.05, 0.3))
    camera = random_camera(4)
    f = RASTER.view(g, camera).footprints
    turn = Rotation.from_quat(g.quats_wxyz[0, [1, 2, 3, 0]]).as_matrix()
    sigma = turn @ np.diag(np.exp(2 * g.log_scales[0].astype(float))) @ turn.T

    def to_pixel(point):
        return camera.project(point[None])[0][0]

    centre, step = g.means[0].astype(float), 1e-5
    jacobian = np.stack(
        [(to_pixel(centre + step * e) - to_pixel(centre - step * e)) / (2 * step) for e in np.eye(3)], -1
    )
    covariance = jacobian @ sigma @ jacobian.T + 0.3 * np.eye(2)
    xx, xy, yy = f.conics[0]
    np.testing.assert_allclose(np.linalg.inv(covariance), [[xx, xy], [xy, yy]], rtol=1e-6)
    np.testing.assert_allclose(f.means_px[0], to_pixel(centre), atol=1e-9)


def test_without_perspective_the_map_is_linear():
    """Pixels are fx x + cx, and the covariance is J R S S^T R^T J^T + 0.3 I with J = diag(fx, fy)."""
    g, camera = random_gaussians(20, seed=3, sh_degree=3), without_perspective(random_camera(4))
    f = RASTER.view(g, camera).footprints
    in_camera = g.means.astype(float) @ camera.rotation.T + camera.world_to_camera[:3, 3]
    assert (in_camera[:, 2] > 1).all()
    pixels = in_camera[:, :2] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    np.testing.assert_allclose(f.means_px, pixels, atol=1e-9)
    np.testing.assert_allclose(f.depths, in_camera[:, 2], atol=1e-12)
    across = np.diag([camera.fx, camera.fy]) @ camera.rotation[:2]
    for conic, covariance in zip(f.conics, covariances(g), strict=True):
        want = np.linalg.inv(across @ covariance @ across.T + 0.3 * np.eye(2))
        np.testing.assert_allclose(conic, want[[0, 0, 1], [0, 1, 1]], rtol=1e-6, atol=1e-9)
    found, _ = camera.project(g.means.astype(float))
    np.testing.assert_allclose(found, pixels, atol=1e-12)
    seen = colours_seen(g, camera)
    np.testing.assert_allclose(seen, colours(g.sh, camera.rotation[2] + 0 * g.means, np.zeros(3)), atol=1e-6)


def test_antialiasing_fades_small_footprints_only():
    small, large = (
        RASTER.view(balls([3.0], [0.8], scale), AXIS, replace(INRIA, antialiased=True)).footprints
        for scale in (0.005, 2.0)
    )
    variance = (30.0 * 0.005 / 3.0) ** 2
    np.testing.assert_allclose(small.opacities, 0.8 * variance / (variance + 0.3), rtol=1e-6)
    np.testing.assert_allclose(large.opacities, 0.8, rtol=1e-3)


def load_golden(path: Path) -> tuple[Gaussians, Camera, Array]:
    """Gaussians, camera and (H, W, 4) image on black; the camera is the one the image was made with."""
    data = load_file(path)
    gaussians = Gaussians(data["means"], data["scales"], data["quats"], data["opacities"], data["coeffs"])
    height, width, _ = data["out_img"].shape
    matrix = np.eye(4)
    matrix[:3, 3] = (-0.123, -0.456, 8.0)
    camera = Camera(width, height, width / 2, width / 2, width / 2, height / 2, matrix)
    return gaussians, camera, data["out_img"]


@pytest.mark.parametrize("case", ["tiny_case", "basic_case"])
@pytest.mark.parametrize("rasterizer", [RASTER, CpuRasterizer()], ids=["reference", "cpu"])
def test_golden_images_of_gsplat(real_data, case, rasterizer):
    gaussians, camera, want = load_golden(real_data / "golden" / f"{case}.safetensors")
    image, alpha = rasterizer.view(gaussians, camera, GSPLAT).splat(
        colours(gaussians.sh, gaussians.means, camera.position)
    )
    np.testing.assert_allclose(np.dstack([image, alpha]), want, atol=1e-5, rtol=0.01)


def test_the_band_finds_a_pixel_on_the_contour():
    variance = (30.0 * 0.2 / 3.0) ** 2 + 0.3
    on_contour = np.exp(0.5 * 16 / variance) / 255  # alpha is 1/255 four pixels from the centre
    band = RASTER.view(balls([3.0], [on_contour]), AXIS).cut_off_band(BAND)
    assert band[10, 14]
    assert band[6, 10]
    assert band.sum() == 4


# The front door: one call from a scene and a camera to a picture.

G, CAMERA = random_gaussians(80, 4, sh_degree=2), random_camera(2)
either = pytest.mark.parametrize("backend", ["cpu", "reference"])


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


@either
def test_larger_images_show_what_photographs_showed(backend: str) -> None:
    """Gaussians thinner than a pixel are all dilation: an image four times as large has as much of it."""
    points = np.full_like(G.log_scales, -9.0)
    thin = replace(G, log_scales=points, sh=G.sh[:, :1], opacity_logits=G.opacity_logits + 9)
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


@either
@pytest.mark.parametrize("factor", [2, 4])
def test_smaller_images_are_means_of_larger_ones(backend: str, factor: int) -> None:
    """Error of the images that photographs of that size would be, beside that with all of the dilation."""
    small = CAMERA.resized(CAMERA.width // factor, CAMERA.height // factor)
    large = small.resized(factor * small.width, factor * small.height)
    thin = replace(G, log_scales=G.log_scales - 2, opacity_logits=G.opacity_logits + 3)
    pixels = render(Scene(thin), large, backend=backend).colours
    means = pixels.reshape(small.height, factor, small.width, factor, 3).mean((1, 3))
    got = render(Scene(thin, cameras=(large,)), small, backend=backend).colours
    before = render(Scene(thin), small, backend=backend).colours
    assert np.square(got - means).mean() < 0.1 * np.square(before - means).mean()


@pytest.mark.parametrize("factor", [1e-30, 1e-3, 0.1])
def test_impossible_focal_lengths_do_not_dilate(factor: float) -> None:
    wrong = replace(CAMERA, fx=CAMERA.fx * factor, fy=CAMERA.fy * factor)
    assert Scene(G, cameras=(wrong,)).raster_settings().focal is None
    settings = replace(INRIA, focal=wrong.fx)
    assert protocol.dilation(CAMERA, settings).added <= protocol.MOST_GROWTH * INRIA.dilation


@either
def test_a_view_is_formed_as_the_scene_was_trained(backend):
    """Antialiasing and the focal length that dilation follows; settings that are given take their place."""
    fitted = Scene(G, cameras=(CAMERA,), antialiased=True)
    camera, x = CAMERA.resized(3 * CAMERA.width, 3 * CAMERA.height), random_values(len(G), 2)
    rasterizer = load_lifting_rasterizer(backend)
    focal = float(np.sqrt(CAMERA.fx * CAMERA.fy))
    own = replace(INRIA, near=fitted.near, antialiased=True, focal=focal)
    for got, settings in (
        (view_of(fitted, camera, rasterizer), own),
        (view_of(fitted, camera, rasterizer, INRIA), INRIA),
    ):
        want = rasterizer.view(G, camera, settings).splat(x)[0]
        np.testing.assert_array_equal(got.splat(x)[0], want)
    drawn = render(fitted, camera, x, backend).values
    np.testing.assert_allclose(drawn, rasterizer.view(G, camera, own).splat(x)[0], atol=1e-5)
    assert np.abs(drawn - rasterizer.view(G, camera).splat(x)[0]).max() > 0.01
    gsplats = fitted.raster_settings(GSPLAT)
    assert gsplats == replace(GSPLAT, antialiased=True, focal=focal)
    drawn = render(fitted, camera, x, backend, GSPLAT).values
    np.testing.assert_allclose(drawn, rasterizer.view(G, camera, gsplats).splat(x)[0], atol=1e-5)


def test_backends_that_cannot_draw_or_lift_are_refused():
    with pytest.raises(InputError, match="choose one of reference, cpu, opengl, cuda"):
        render(Scene(G), CAMERA, backend="vulkan")
    with pytest.raises(ValueError, match=r"values: expected shape \(N, C\) with {'N': 80}"):
        render(Scene(G), CAMERA, random_values(160, 2))
    for backend in ("cuda", "opengl"):  # which needs a device handed to it
        with pytest.raises(BackendError, match="--backend cpu"):
            render(Scene(G), CAMERA, backend=backend)
    assert load_lifting_rasterizer("auto").name == "cpu"
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
def test_pixel_weights_are_a_row_of_w(distance, orthographic):
    gaussians = random_gaussians(400, 3, scale_range=(0.005, 0.5))
    camera = view_from(distance)
    camera = without_perspective(camera) if orthographic else camera
    formed = Scene(gaussians).raster_settings()
    truth = load_lifting_rasterizer("reference").view(gaussians, camera, formed)
    for column, row in [(0, 0), (63, 47), (32, 24), (20, 40), (50, 5)]:
        image = np.zeros((48, 64, 1))
        image[row, column] = 1
        rows, weights = pixel_weights(Scene(gaussians), camera, (column, row))
        got = np.zeros(len(gaussians))
        got[rows] = weights
        assert (weights > 0).all()
        np.testing.assert_allclose(got, truth.gather(image)[:, 0], atol=2e-5)


def test_empty_scenes_have_no_pixel_weights():
    rows, weights = pixel_weights(Scene(random_gaussians(20).take(slice(0))), view_from(3.0), (1, 1))
    assert len(rows) == len(weights) == 0
