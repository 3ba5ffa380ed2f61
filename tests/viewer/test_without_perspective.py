"""Looking without perspective: pixels, depths, framing, and what is left out."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from langsplat_core.config import PictureConfig
from langsplat_viewer.camera.controls import (
    OrbitCamera,
    between,
    default_view,
    extent_of,
    frame_all,
    from_camera,
    from_side,
    spanning,
    with_projection,
    zoom,
)
from langsplat_viewer.camera.flight import Flight, Keyframe, camera_of, pose_at, pose_of
from langsplat_viewer.rendering.renderer import GlRenderer
from langsplat_viewer.rendering.request import Clip, depth_range, image_formation, plain_request, why_nothing
from tests.support.fakes import CENTRES, blob_scene

SIZE = (1280, 720)
SIDES = ("front", "back", "left", "right", "top", "bottom")
BLOBS = blob_scene()
EXTENT = extent_of(BLOBS)
VIEW = default_view(BLOBS, EXTENT, SIZE)
FLAT = with_projection(VIEW, orthographic=True)


def exact(view: OrbitCamera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, 2) pixels in an orthographic picture of the target's scale, and depths from the eye."""
    x, y, z = view.rotation @ (np.asarray(points, np.float64) - view.eye).T
    inner = view.intrinsics.fitted(*SIZE)
    pixels = [inner.fx / view.distance * x + inner.cx, inner.fy / view.distance * y + inner.cy]
    return np.stack(pixels, 1), z


def test_the_camera_is_orthographic():
    wanted, depths = exact(FLAT, BLOBS.gaussians.means)
    found, z = FLAT.camera(*SIZE).project(BLOBS.gaussians.means.astype(np.float64))
    assert_allclose(found, wanted, atol=1e-9)
    assert_allclose(z, depths, atol=1e-12)


@pytest.mark.parametrize("backend", ["opengl", "cpu"])
def test_what_is_clicked_is_where_it_is(gl, backend):
    """By the depth of one pixel, and by that of all of them."""
    camera = FLAT.camera(320, 240)
    renderer, request = GlRenderer(gl, backend, "half"), plain_request(BLOBS, camera, PictureConfig())
    for centre in CENTRES:
        (pixel,), _ = camera.project(centre[None])
        x, y = np.floor(pixel) + 0.5
        one, every = renderer.depth_at(request, x, y), renderer.depth_map(request)[int(y), int(x)]
        for depth in (one, every):
            found = camera.unproject((x, y), float(depth)) - centre
            assert -0.5 < found @ FLAT.rotation[2] < 0.1  # the front of the blob
            assert np.linalg.norm(found[:2]) < 0.3
    assert renderer.depth_at(request, 2.5, 2.5) is None
    renderer.release()


def test_the_plane_through_the_target_keeps_its_scale():
    across = VIEW.target + 0.3 * VIEW.rotation[0] - 0.7 * VIEW.rotation[1]
    points = np.stack([VIEW.target, across])
    assert_allclose(FLAT.camera(*SIZE).project(points)[0], VIEW.camera(*SIZE).project(points)[0], atol=1e-9)
    assert with_projection(FLAT, orthographic=False).camera(*SIZE).intrinsics == VIEW.camera(*SIZE).intrinsics
    assert FLAT.span == pytest.approx(2 * np.tan(np.radians(VIEW.intrinsics.fov_degrees / 2)) * VIEW.distance)


def test_a_span_is_what_the_shorter_side_shows():
    view = spanning(VIEW, 2.5)
    assert view.span == pytest.approx(2.5)
    assert_allclose(view.eye, VIEW.eye, atol=1e-12)
    top, foot = view.target - 1.25 * view.rotation[1], view.target + 1.25 * view.rotation[1]
    pixels, _ = view.camera(*SIZE).project(np.stack([foot, top]))
    (_, low), (_, high) = pixels
    assert abs(low - high) == pytest.approx(SIZE[1])
    assert view.span_in(*SIZE) == pytest.approx(2.5)
    assert view.span_in(120, 720) == pytest.approx(2.5 * 160 / 120)  # the photograph's whole width is seen


def test_an_orthographic_camera_gives_its_view_back_at_any_size():
    view = spanning(VIEW, 2.5)
    camera = view.camera(320, 240).resized(640, 480)
    assert camera.orthographic
    again = from_camera(camera, EXTENT)
    assert_allclose(again.target, view.target, atol=1e-9)
    assert again.span == pytest.approx(2.5)
    assert_allclose(again.camera(640, 480).world_to_camera, camera.world_to_camera, atol=1e-9)


def test_what_lies_behind_the_eye_is_left_out_and_cuts_count_from_the_eye():
    inside = replace(
        FLAT, target=FLAT.target - 0.2 * FLAT.rotation[2], distance=0.2
    )  # the eye among the blobs
    camera = inside.camera(*SIZE)
    _, z = exact(inside, BLOBS.gaussians.means)
    _, depths = camera.project(BLOBS.gaussians.means.astype(np.float64))
    for clip in (Clip(), Clip(0.1, 0.3)):
        settings = image_formation(BLOBS, camera, clip)
        shown = depths > settings.near
        shown &= depths <= (np.inf if settings.far is None else settings.far)
        np.testing.assert_array_equal(shown, (z > clip.near) & (z <= clip.far))
        assert 0 < shown.sum() < len(shown)
        low, high = depth_range(BLOBS.gaussians, camera, clip)
        assert clip.near <= low < high <= min(clip.far, 3.0)
    beyond = replace(inside, target=inside.target + 50 * inside.rotation[2])
    assert "behind the camera" in why_nothing(BLOBS.gaussians, beyond.camera(*SIZE))


@pytest.mark.parametrize("side", SIDES)
def test_framing_holds_the_scene_and_nothing_of_it_is_behind_the_eye(side):
    view = frame_all(from_side(FLAT, side), EXTENT, SIZE)
    pixels, z = exact(view, EXTENT.sample.points)
    inside = (pixels >= 0).all(1) & (pixels <= SIZE).all(1) & (z > 0)
    assert EXTENT.sample.weights[inside].sum() > 0.979 * EXTENT.sample.weights.sum()
    filled = (np.ptp(pixels, axis=0) / SIZE).max()
    assert 0.8 < filled < 1.2 or side in ("left", "right")  # along the row they look small


def test_zooming_in_ends_where_nothing_gets_larger():
    assert zoom(FLAT, 0.5, 0.1).span == pytest.approx(0.5 * FLAT.span)
    nearest = zoom(replace(FLAT, distance=0.1), 0.5, 0.1)
    assert nearest.distance == 0.1
    assert_allclose(nearest.target, FLAT.target)


def test_a_glide_has_the_projection_of_its_end():
    assert between(VIEW, FLAT, 0.3).orthographic
    assert not between(FLAT, VIEW, 0.3).orthographic


def flight_of(*views: OrbitCamera) -> Flight:
    return Flight(tuple(Keyframe(float(at), pose_of(view)) for at, view in enumerate(views)))


def test_keyframes_keep_projection_and_scale():
    flat = [spanning(from_side(VIEW, side), span) for side, span in (("front", 1.0), ("top", 4.0))]
    flight = flight_of(*flat, VIEW)
    for at, wanted in enumerate((*flat, VIEW)):
        found = camera_of(pose_at(flight, at), EXTENT, SIZE)
        assert_allclose(found.world_to_camera, wanted.camera(*SIZE).world_to_camera, atol=1e-7)
        assert found.orthographic == wanted.orthographic
        assert found.fx == pytest.approx(wanted.camera(*SIZE).fx)
    assert pose_at(flight_of(*flat), 0.5).span == pytest.approx(2.0)
    assert pose_at(flight, 1.5).span == pytest.approx(4.0)  # till the next keyframe
    assert pose_at(flight_of(VIEW, VIEW, flat[0]), 0.5).span is None
