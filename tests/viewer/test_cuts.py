"""The near and the far cut."""

import math
from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.config import PictureConfig
from langsplat_core.raster.protocol import farthest
from langsplat_core.scene import look_at
from langsplat_viewer.actions import selecting, settings, viewpoint
from langsplat_viewer.camera.controls import from_camera
from langsplat_viewer.canvas import NOTHING_BETWEEN, Canvas
from langsplat_viewer.rendering.renderer import GlRenderer
from langsplat_viewer.rendering.request import UNCLIPPED, Clip, depth_range, image_formation, plain_request
from tests.support.fakes import CENTRES, blob_scene
from tests.support.windowless import marked, rest

SIZE = (160, 120)
# From the side: the blobs lie behind each other, mug, book, plant, at depths of about 3.8, 5 and 6.2.
SIDE = look_at(np.array([-5.0, 0, 0]), np.zeros(3), np.array([0, -1.0, 0]), SIZE)
BOOK_ALONE = Clip(4.4, 5.6)
DEPTHS = blob_scene().gaussians.means @ SIDE.rotation[2] + SIDE.world_to_camera[2, 3]


@pytest.mark.parametrize("backend", ["cpu", "opengl"])
@pytest.mark.parametrize("display", ["rgb", "depth", "alpha"])
@pytest.mark.parametrize("clip", [BOOK_ALONE, Clip(near=4.4), Clip(far=4.4)])
def test_what_is_cut_away_is_as_if_it_were_not_there(gl, backend, display, clip):
    scene = blob_scene()
    kept = scene.take(np.flatnonzero(clip.keeps(DEPTHS)))
    assert 0 < len(kept.gaussians) < 360
    renderer, whole = (
        GlRenderer(gl, backend, "single"),
        plain_request(scene, SIDE, PictureConfig(display=display)),
    )
    expected = renderer.read(plain_request(kept, SIDE, whole.picture)).astype(int)
    seen = [renderer.read(request).astype(int) for request in (whole, replace(whole, clip=clip), whole)]
    renderer.release()
    np.testing.assert_allclose(seen[1], expected, atol=1)
    assert np.abs(seen[1] - seen[0]).max() > 20
    np.testing.assert_array_equal(seen[2], seen[0])


def test_the_near_cut_never_comes_nearer_than_the_near_plane_and_the_far_one_is_none_by_itself():
    scene = blob_scene()
    plain = image_formation(scene, SIDE)
    assert image_formation(scene, SIDE, Clip(0.01, 7.0)) == replace(plain, far=7.0)
    assert image_formation(scene, SIDE, Clip(3.0)) == replace(plain, near=3.0)
    assert (plain.far, farthest(plain)) == (None, math.inf)


def test_the_scale_of_depth_is_that_of_what_is_left():
    near, far = depth_range(blob_scene().gaussians, SIDE, BOOK_ALONE)
    assert 4.4 < near < far < 5.6


def test_the_far_cut_stays_the_farther(opened):
    settings.set_clip(opened, Clip(3.0, 2.0))
    assert opened.state.settings.clip == Clip(3.0, 3.0)
    settings.set_clip(opened, Clip(-1.0, 2.0))
    assert opened.state.settings.clip == Clip(0.0, 2.0)


@pytest.fixture
def beside(opened):
    """Stands at `SIDE`."""
    settings.resize(opened, *SIZE)
    viewpoint.move(opened, lambda view: from_camera(SIDE, opened.state.extent))
    return opened


def test_the_canvas_draws_another_cut_once_and_says_where_nothing_is_left(gl, beside):
    renderer = GlRenderer(gl, "cpu")
    canvas, state = Canvas(gl, renderer), beside.state
    rest(canvas, state, 0.0)
    settings.set_clip(beside, BOOK_ALONE)
    rest(canvas, state, 1.0)
    book = np.frombuffer(canvas.textures[0].read(), np.uint8).reshape(120, 160, 4)[60, 80]
    assert book[:3].argmax() == 1
    assert abs(canvas.point_at(0.5, 0.5)[0] - CENTRES[1][0]) < 0.6  # of the surface that is seen
    settings.set_clip(beside, Clip(20.0, 30.0))
    rest(canvas, state, 2.0)
    assert state.nothing == NOTHING_BETWEEN
    settings.set_clip(beside, UNCLIPPED)
    rest(canvas, state, 3.0)
    assert state.nothing == ""
    renderer.release()


def test_an_outline_does_not_select_what_is_cut_away(beside):
    selecting.use_tool(beside, "rectangle")
    settings.set_clip(beside, BOOK_ALONE)
    selecting.begin_stroke(beside, 0.0, 0.0)
    selecting.extend_stroke(beside, 1.0, 1.0)
    selecting.end_stroke(beside)
    assert marked(beside)[0] == "book"
