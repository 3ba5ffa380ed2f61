"""The reference against closed forms: what a rasterizer must do where the answer is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from langsplat_core.arrays import Array, logit
from langsplat_core.config import GSPLAT, INRIA
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.raster.reference import ReferenceRasterizer, colours
from langsplat_core.raster.render import colours_seen
from langsplat_core.scene import Camera, Gaussians
from tests.support.comparing import BAND, assert_adjoint
from tests.support.scenes import (
    covariances,
    random_camera,
    random_gaussians,
    random_values,
    without_perspective,
)

RASTER = ReferenceRasterizer()


def balls(depths, opacities, scale=0.2):
    """Isotropic Gaussians on the optical axis of `axis_camera`."""
    n = len(depths)
    means = np.zeros((n, 3))
    means[:, 2] = depths
    scales = np.full((n, 3), np.log(scale))
    return Gaussians(
        means, scales, np.tile([1.0, 0, 0, 0], (n, 1)), logit(np.array(opacities)), np.zeros((n, 1, 3))
    )


def axis_camera(size=21, focal=30.0):
    return Camera(size, size, focal, focal, size / 2, size / 2, np.eye(4))


def test_one_ball_on_the_axis_is_a_gaussian_of_known_width():
    camera = axis_camera()
    image, alpha = RASTER.view(balls([3.0], [0.8]), camera).splat(np.full((1, 1), 2.5))
    variance = (30.0 * 0.2 / 3.0) ** 2 + 0.3
    offset = np.arange(21) + 0.5 - 10.5
    want = 0.8 * np.exp(-0.5 * (offset[:, None] ** 2 + offset**2) / variance)
    want[want < 1 / 255] = 0
    np.testing.assert_allclose(alpha, want, atol=1e-7)  # the opacity is a float32 logit
    np.testing.assert_allclose(image[..., 0], 2.5 * want, atol=3e-7)


def test_the_nearer_of_two_hides_the_farther():
    view = RASTER.view(balls([4.0, 3.0], [0.5, 0.6]), axis_camera())
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
    w, x, y, z = g.quats_wxyz[0].astype(float) / np.linalg.norm(g.quats_wxyz[0].astype(float))
    axis_angle = np.array([x, y, z])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = (
        np.eye(3) * (w * w - axis_angle @ axis_angle) + 2 * np.outer(axis_angle, axis_angle) + 2 * w * cross
    )
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
    found, depths = camera.project(g.means.astype(float))
    np.testing.assert_allclose(found, pixels, atol=1e-12)
    back = [camera.unproject(tuple(pixel), z) for pixel, z in zip(found, depths, strict=True)]
    np.testing.assert_allclose(back, g.means, atol=1e-6)
    seen = colours_seen(g, camera)
    np.testing.assert_allclose(seen, colours(g.sh, camera.rotation[2] + 0 * g.means, np.zeros(3)), atol=1e-6)


def test_every_pixel_is_covered_or_seen_through():
    """Weights and what is left of the light add up to 1, here in closed form: flat layers over the frame."""
    opacities = np.array([0.3, 0.5, 0.2, 0.6])
    view = RASTER.view(balls([3.0, 4.0, 5.0, 6.0], opacities, scale=1e4), axis_camera())
    weights, alpha = view.splat(np.eye(4))
    left = np.cumprod(1 - opacities)
    want = opacities * np.concatenate([[1], left[:-1]])
    np.testing.assert_allclose(weights, np.broadcast_to(want, weights.shape), atol=1e-6)
    np.testing.assert_allclose(alpha + left[-1], 1, atol=1e-6)


def test_a_rigid_motion_of_world_and_camera_changes_nothing():
    """Also the way back: a full orbit in seven steps ends with the picture it began with."""
    g, camera = random_gaussians(30, seed=8), random_camera(8, 30, 20)
    x = random_values(30, 3)
    image = RASTER.view(g, camera).splat(x)[0]
    angle = 2 * np.pi / 7
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    c, s = np.cos(angle / 2), np.sin(angle / 2)
    q = g.quats_wxyz.astype(np.float64).T
    quats = np.stack([c * q[0] - s * q[3], c * q[1] - s * q[2], c * q[2] + s * q[1], c * q[3] + s * q[0]], -1)
    turned = replace(g, means=g.means @ turn.T, quats_wxyz=quats)
    back = np.eye(4)
    back[:3, :3] = turn.T
    moved = replace(camera, world_to_camera=camera.world_to_camera @ back)
    np.testing.assert_allclose(RASTER.view(turned, moved).splat(x)[0], image, atol=2e-6)  # float32 means
    for _ in range(7):
        camera = replace(camera, world_to_camera=camera.world_to_camera @ back)
    np.testing.assert_allclose(RASTER.view(g, camera).splat(x)[0], image, atol=1e-12)


def test_extent_is_where_alpha_reaches_its_minimum():
    f = RASTER.view(balls([3.0], [0.8]), axis_camera()).footprints
    sigma = np.sqrt((30.0 * 0.2 / 3.0) ** 2 + 0.3)
    np.testing.assert_allclose(f.extents_px[0], sigma * np.sqrt(2 * np.log(255 * 0.8)), rtol=1e-6)


def test_weights_are_linear_sum_to_alpha_and_have_an_adjoint():
    g, camera = random_gaussians(40, seed=5), random_camera(5, 33, 20)
    view = RASTER.view(g, camera)
    x, y = random_values(40, 2, 1).astype(float), random_values(40, 2, 2).astype(float)
    one, alpha = view.splat(np.ones((40, 1)))
    np.testing.assert_allclose(one[..., 0], alpha, atol=1e-12)
    assert alpha.min() >= 0
    assert alpha.max() <= 1 - 1e-4
    mixed = view.splat(2 * x - 3 * y)[0]
    np.testing.assert_allclose(mixed, 2 * view.splat(x)[0] - 3 * view.splat(y)[0], atol=1e-12)
    target = np.random.default_rng(0).normal(size=(20, 33, 2))
    assert_adjoint(lambda v: view.splat(v)[0], view.gather, x, target, rtol=1e-12)


def test_antialiasing_lowers_the_opacity_of_small_footprints_only():
    small, large = (
        RASTER.view(balls([3.0], [0.8], scale), axis_camera(), replace(INRIA, antialiased=True)).footprints
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
    camera = axis_camera()
    variance = (30.0 * 0.2 / 3.0) ** 2 + 0.3
    on_contour = np.exp(0.5 * 16 / variance) / 255  # alpha is 1/255 four pixels from the centre
    band = RASTER.view(balls([3.0], [on_contour]), camera).cut_off_band(BAND)
    assert band[10, 14]
    assert band[6, 10]
    assert band.sum() == 4
