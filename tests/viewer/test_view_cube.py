"""The cube that shows and turns the view."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_viewer.actions import settings
from langsplat_viewer.camera.controls import default_view, extent_of, from_side, orbit
from langsplat_viewer.camera.overlays import FACES, face_at, facing, visible_faces, world_axes
from tests.support.fakes import blob_scene
from tests.support.windowless import arrive

SCENE = blob_scene()
VIEW = replace(default_view(SCENE, extent_of(SCENE), (200, 100)), up=np.array([0.0, -1.0, 0.0]))


@pytest.mark.parametrize("name", FACES)
def test_a_face_that_is_turned_to_is_the_only_one_seen(name):
    turned = facing(VIEW, name)
    np.testing.assert_allclose(turned.target, VIEW.target)
    assert turned.distance == VIEW.distance
    np.testing.assert_allclose(turned.rotation @ turned.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turned.rotation) == pytest.approx(1)
    (face,) = visible_faces(turned)
    assert (face.name, face.towards) == (name, pytest.approx(1))
    np.testing.assert_allclose(np.abs(face.corners), 1, atol=1e-9)
    if name not in ("top", "bottom"):
        np.testing.assert_allclose(-turned.rotation[1], VIEW.up, atol=1e-9)


@pytest.mark.parametrize("name", FACES)
def test_from_any_side_the_face_in_front_is_under_its_centre(name):
    pitch = -0.3 if name == "top" else 0.3  # away from the pole
    view = orbit(orbit(facing(VIEW, name), 0.4, 0.0), 0.0, pitch)
    faces = visible_faces(view)
    assert 2 <= len(faces) <= 3
    for face in faces:
        assert face_at(faces, tuple(face.centre)) == face.name
    assert face_at(faces, (3.0, 0.0)) == ""


def test_the_scene_seen_from_the_right_has_the_right_face():
    """The mug lies at -x, the plant at +x, and up is -y: from the right the plant is nearest."""
    right = facing(VIEW, "right")
    assert right.eye[0] > VIEW.target[0]
    assert facing(VIEW, "top").eye[1] < VIEW.target[1]


def test_the_worlds_axes_on_screen():
    axes = world_axes(facing(VIEW, "front"))
    np.testing.assert_allclose(np.abs(axes), np.eye(3), atol=1e-9)
    assert axes[0, 0] > 0.9  # x to the right
    assert axes[1, 1] > 0.9  # y down, as up is -y


def test_a_click_glides_there(opened):
    settings.turn_to_face(opened, "top")
    assert opened.state.glide is not None
    arrive(opened)
    assert visible_faces(opened.state.view)[0].name == "top"


@pytest.mark.parametrize("side", ["front", "back", "left", "right", "top", "bottom"])
@pytest.mark.parametrize("up", [(0, -1, 0), (0, 0, 1), (0.1, -0.9, 0.4)])
def test_keys_and_cube_call_the_sides_by_the_same_names(side, up):
    view = replace(VIEW, up=np.array(up, float) / np.linalg.norm(up))
    (face,) = visible_faces(from_side(view, side))
    assert face.name == side
