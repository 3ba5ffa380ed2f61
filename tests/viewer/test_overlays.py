"""Lines over the picture, against plain arithmetic."""

import math

import numpy as np
import pytest

from langsplat_core.query import instances
from langsplat_core.scene import look_at
from langsplat_viewer.camera import overlays
from langsplat_viewer.camera.controls import extent_of, frame_of
from tests.support.fakes import blob_scene, cameras

SIZE = (120, 80)
NEAR = 0.05


def plain_clip(camera, start, end):
    """One segment cut at one plane after the other, in plain Python: (2, 2) pixels or None."""
    a, b = (camera.rotation @ p + camera.world_to_camera[:3, 3] for p in (start, end))
    planes = [
        lambda p: p[2] - NEAR,
        lambda p: camera.fx * p[0] + camera.cx * p[2],
        lambda p: (camera.width - camera.cx) * p[2] - camera.fx * p[0],
        lambda p: camera.fy * p[1] + camera.cy * p[2],
        lambda p: (camera.height - camera.cy) * p[2] - camera.fy * p[1],
    ]
    for side in planes:
        if side(a) < 0 and side(b) < 0:
            return None
        if side(a) < 0:
            a = a + side(a) / (side(a) - side(b)) * (b - a)
        elif side(b) < 0:
            b = b + side(b) / (side(b) - side(a)) * (a - b)
    return np.array(
        [(p[0] / p[2] * camera.fx + camera.cx, p[1] / p[2] * camera.fy + camera.cy) for p in (a, b)]
    )


def test_segments_are_cut_as_plain_arithmetic_cuts_them():
    rng = np.random.default_rng(4)
    camera = look_at(np.array([0.3, -0.2, -2.0]), np.zeros(3), np.array([0, -1.0, 0]), SIZE)
    segments = rng.normal(scale=2.5, size=(4000, 2, 3))
    got, rows = overlays.clip_segments(camera, segments, NEAR)
    expected = [plain_clip(camera, *segment) for segment in segments]
    assert rows.tolist() == [row for row, cut in enumerate(expected) if cut is not None]
    assert 500 < len(rows) < 3500
    np.testing.assert_allclose(got, [cut for cut in expected if cut is not None], atol=1e-6)
    assert got.min() > -1e-6
    assert (got.max((0, 1)) < np.array(SIZE) + 1e-6).all()


def test_a_segment_through_the_eye_is_cut_in_front_of_it():
    camera = look_at(np.array([0, 0, -2.0]), np.zeros(3), np.array([0, -1.0, 0]), SIZE)
    through = np.array([[[0, 0, -4.0], [0, 0, 3.0]], [[0, 0, -9.0], [0, 0, -3.0]]])
    got, rows = overlays.clip_segments(camera, through, NEAR)
    assert rows.tolist() == [0]
    np.testing.assert_allclose(got[0], [[60, 40], [60, 40]], atol=1e-9)
    far = np.array([[[-1e9, 0, 1.0], [1e9, 0, 1.0]]])
    np.testing.assert_allclose(overlays.clip_segments(camera, far, NEAR)[0][0, :, 0], [0, 120], atol=1e-3)
    assert len(overlays.clip_segments(camera, np.zeros((0, 2, 3)), NEAR)[0]) == 0


def test_a_frustum_ends_where_its_picture_does():
    camera = cameras()[1]
    edges = overlays.frusta([camera], 0.4)[0]
    np.testing.assert_allclose(edges[:4, 0], np.tile(camera.position, (4, 1)), atol=1e-12)
    pixels, depths = camera.project(edges[:4, 1])
    np.testing.assert_allclose(depths, 0.4)
    np.testing.assert_allclose(pixels, [(0, 0), (160, 0), (160, 120), (0, 120)], atol=1e-9)
    assert overlays.frusta([], 1.0).shape == (0, 8, 2, 3)


def test_the_nearest_segment():
    segments = np.array([[[0.0, 0], [10, 0]], [[0, 5], [10, 5]], [[3, 3], [3, 3]]])
    assert overlays.nearest_segment(segments, (20.0, 0.0)) == (0, 10.0)
    assert overlays.nearest_segment(segments, (6.0, 4.5)) == (1, 0.5)
    assert overlays.nearest_segment(segments, (3.0, 2.9))[0] == 2
    assert overlays.nearest_segment(segments[:0], (0.0, 0.0)) == (-1, math.inf)


@pytest.mark.parametrize("up", [(0, -1, 0), (0, 0, 1), (0.1, -0.9, 0.4)])
def test_the_frame_is_a_right_handed_one_with_up_as_up(up):
    up = np.array(up, float) / np.linalg.norm(up)
    frame = frame_of(up)
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(frame[1], up)
    assert np.linalg.det(frame) == pytest.approx(1)


@pytest.mark.parametrize(
    ("length", "rounded"), [(1, 1), (1.3, 1), (1.5, 2), (0.031, 0.02), (4, 5), (88, 100), (7e-9, 5e-9)]
)
def test_round_lengths(length, rounded):
    assert overlays.round_length(length) == pytest.approx(rounded)


def test_lengths_in_words():
    assert overlays.length_text(1.23456, None) == "1.235 units"
    assert overlays.length_text(2.0, 0.25) == "0.5 m (2 units)"


@pytest.mark.parametrize("scale", [None, 0.3])
def test_the_grid_lies_level_below_the_scene_at_round_distances(scale):
    scene = blob_scene()
    extent, up = extent_of(scene), np.array([0, -1.0, 0])
    grid = overlays.ground_grid(extent, up, scale)
    heights = grid.segments @ up
    assert np.ptp(heights) < 1e-9
    below = (scene.gaussians.means.astype(float) @ up < heights[0, 0]).mean()
    assert 0 < below < 0.05
    unit = scale or 1.0
    assert overlays.round_length(grid.spacing * unit) == pytest.approx(grid.spacing * unit)
    right = grid.segments[:, 0] @ frame_of(up)[0]
    np.testing.assert_allclose(right / grid.spacing, np.rint(right / grid.spacing), atol=1e-9)
    assert 8 < len(grid.segments) < 40
    for text, point in grid.marks:
        along = frame_of(up)[[0, 2]] @ point * unit
        assert np.abs(along - float(text)).min() < 1e-9


def test_the_edges_of_a_box_join_neighbouring_corners():
    box = instances.OrientedBox(np.array([1.0, 2, 3]), np.eye(3), np.array([3.0, 2, 1]))
    edges = overlays.box_edges(box.corners)
    lengths = np.sort(np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1))
    np.testing.assert_allclose(lengths, [2.0] * 4 + [4.0] * 4 + [6.0] * 4)
    assert len({tuple(sorted(map(tuple, edge))) for edge in edges.tolist()}) == 12
