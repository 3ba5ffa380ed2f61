"""Selecting with the mouse: what a stroke encloses, and what becomes of it. No window."""

import numpy as np
import pytest

from langsplat_core.scene import look_at
from langsplat_viewer import marks
from langsplat_viewer.actions import selecting, settings, undoing, viewpoint
from langsplat_viewer.camera.controls import from_camera
from langsplat_viewer.drawing.channels import Clip
from langsplat_viewer.marks import Drawn, Stroke, caught, outlines
from tests.support.fakes import CENTRES, PER_BLOB
from tests.support.selected import marked, marks_of
from tests.support.windowless import FakeSurface, errors, settle

SIZE = (400, 300)


@pytest.fixture
def front(opened):
    """From straight ahead, so that the blobs lie in a row: mug, book, plant from left to right."""
    camera = look_at(np.array([0, 0, -5.0]), np.zeros(3), np.array([0, -1.0, 0]), SIZE)
    settings.resize(opened, *SIZE)
    viewpoint.move(opened, lambda view: from_camera(camera, opened.state.extent))
    return opened


def place(viewer, point) -> tuple[float, float]:
    """Of a world point, as fractions of the picture."""
    (pixel,), _ = viewer.state.view.camera(*SIZE).project(np.asarray(point, float)[None])
    return pixel[0] / SIZE[0], pixel[1] / SIZE[1]


def around(viewer, centre, radius: float = 0.58) -> list[tuple[float, float]]:
    """Places all around a blob."""
    turns = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    return [place(viewer, centre + radius * np.array([np.cos(t), np.sin(t), 0])) for t in turns]


def draw(viewer, places, mode=None) -> None:
    selecting.begin_stroke(viewer, *places[0])
    for u, v in places[1:]:
        selecting.extend_stroke(viewer, u, v)
    selecting.end_stroke(viewer, mode)


def corners(viewer, centre, half: float = 0.58) -> list[tuple[float, float]]:
    return [place(viewer, centre + half * np.array([sign, sign, 0])) for sign in (-1, 1)]


def test_a_rectangle_selects_the_blob_inside_it_and_is_undone(front):
    selecting.use_tool(front, "rectangle")
    draw(front, corners(front, CENTRES[0]))
    assert marked(front)[0] == "mug"
    draw(front, corners(front, CENTRES[2])[::-1], "add")
    assert marked(front)[0] == "mug plant"
    undoing.undo(front)
    assert marked(front)[0] == "mug"


def test_a_rectangle_of_one_click_selects_nothing(front):
    selecting.use_tool(front, "rectangle")
    draw(front, corners(front, CENTRES[0]))
    draw(front, [(0.01, 0.01)])
    assert marked(front)[0] == ""


def test_a_lasso_selects_what_it_goes_around(front):
    selecting.use_tool(front, "lasso")
    draw(front, around(front, CENTRES[1]))
    assert marked(front)[0] == "book"


def test_a_brush_selects_what_it_sweeps_over(front):
    selecting.use_tool(front, "brush")
    selecting.set_brush(front, 0.12)
    draw(front, [place(front, CENTRES[0]), place(front, CENTRES[1])])
    assert marked(front)[0] == "mug book"
    selecting.set_brush(front, 0.01)
    draw(front, [place(front, CENTRES[2])])
    assert 0 < marks_of(front).selected.sum() < PER_BLOB


@pytest.mark.parametrize("tool", ["sphere", "box"])
def test_a_body_is_as_large_as_the_drag_or_the_reach(front, tool, monkeypatch):
    monkeypatch.setattr(FakeSurface, "point_at", lambda self, u, v: CENTRES[2])
    selecting.use_tool(front, tool)
    draw(front, [place(front, CENTRES[2]), place(front, CENTRES[2] + [0.7, 0, 0])])
    assert marked(front)[0] == "plant"
    draw(front, [place(front, CENTRES[2])])  # a click
    offsets = np.abs(front.state.scene.gaussians.means - CENTRES[2])
    far = np.linalg.norm(offsets, axis=1) if tool == "sphere" else offsets.max(1)
    np.testing.assert_array_equal(marks_of(front).selected, far <= selecting.reach(front))
    assert marks_of(front).selected.any()


def test_what_lies_behind_something_is_left_out_unless_all_is_wanted(front, monkeypatch):
    monkeypatch.setattr(FakeSurface, "depths", lambda self: np.full((30, 40), 4.95))
    selecting.use_tool(front, "rectangle")
    draw(front, corners(front, CENTRES[1]))
    z = front.state.scene.gaussians.means[:, 2]
    in_front = marks_of(front).selected
    selecting.set_only_visible(front, False)
    draw(front, corners(front, CENTRES[1]))
    assert marked(front)[0] == "book"
    np.testing.assert_array_equal(in_front, marks_of(front).selected & (z + 5 <= 4.95 * 1.03))
    assert 20 < in_front.sum() < 100


def test_in_parallel_projection_strokes_meet_the_same(front, monkeypatch):
    """Depths count from the eye: what hides, and what is cut away."""
    viewpoint.toggle_orthographic(front)
    back = front.state.view.back
    monkeypatch.setattr(FakeSurface, "depths", lambda self: np.full((30, 40), back + 4.95))
    z = front.state.scene.gaussians.means[:, 2]
    selecting.use_tool(front, "lasso")
    draw(front, around(front, CENTRES[0], 0.7))
    in_front = marks_of(front).selected
    selecting.set_only_visible(front, False)
    draw(front, around(front, CENTRES[0], 0.7))
    assert marked(front)[0] == "mug"
    np.testing.assert_array_equal(in_front, marks_of(front).selected & (z + 5 <= 4.95 * 1.03))
    assert 20 < in_front.sum() < 100
    settings.set_clip(front, Clip(5.0))
    draw(front, around(front, CENTRES[0], 0.7))
    assert 20 < marks_of(front).selected.sum() < 100
    assert (z[marks_of(front).selected] > 0).all()


def test_a_click_selects_the_thing_at_the_level_of_the_queries(front, monkeypatch):
    monkeypatch.setattr(FakeSurface, "point_at", lambda self, u, v: CENTRES[1])
    selecting.use_tool(front, "thing")
    draw(front, [(0.5, 0.5)])
    settle(front)
    assert marked(front)[0] == "book"
    undoing.undo(front)
    assert marked(front)[0] == ""


def test_a_click_on_nothing_and_without_a_field(front, monkeypatch):
    selecting.use_tool(front, "sphere")
    draw(front, [(0.95, 0.5)])  # where the picture is empty
    assert "nothing under the cursor" in front.state.messages[-1].text
    front.state.scene = type(front.state.scene)(front.state.scene.gaussians)
    selecting.use_tool(front, "thing")
    draw(front, [(0.5, 0.5)])
    assert "without a language field" in errors(front)[-1]
    assert marked(front) == ("", "", "")


def test_escape_gives_up_the_stroke_then_the_tool_and_help_before_both(front):
    selecting.use_tool(front, "lasso")
    selecting.begin_stroke(front, 0.1, 0.1)
    settings.show_help(front, True)
    settings.escape(front)
    assert front.state.selection.stroke is not None
    settings.escape(front)
    assert (front.state.selection.stroke, front.state.selection.tool) == (None, "lasso")
    selecting.end_stroke(front)  # of nothing
    settings.escape(front)
    assert front.state.selection.tool is None
    assert marked(front) == ("", "", "")


def test_a_stroke_keeps_only_places_that_differ(front):
    selecting.begin_stroke(front, 0.1, 0.1)
    assert front.state.selection.stroke is None  # no tool
    selecting.use_tool(front, "brush")
    selecting.begin_stroke(front, 0.1, 0.1)
    for u in (0.1, 0.1 + 1e-5, 0.2, 0.2):
        selecting.extend_stroke(front, u, 0.1)
    assert front.state.selection.stroke.path == ((0.1, 0.1), (0.2, 0.1))


def drawn(tool, path, centre=None) -> Drawn:
    camera = look_at(np.array([0, 0, -5.0]), np.zeros(3), np.array([0, -1.0, 0]), SIZE)
    return Drawn(tool, Stroke(tuple(path), centre), camera, 0.03, 0.5)


def test_outlines_are_what_is_enclosed():
    (rectangle,) = outlines(drawn("rectangle", [(0.2, 0.3), (0.6, 0.5)]))
    assert rectangle.tolist() == [[0.2, 0.3], [0.6, 0.3], [0.6, 0.5], [0.2, 0.5], [0.2, 0.3]]
    (lasso,) = outlines(drawn("lasso", [(0.2, 0.3), (0.6, 0.5), (0.1, 0.9)]))
    assert lasso[0].tolist() == lasso[-1].tolist()
    (brush,) = outlines(drawn("brush", [(0.2, 0.3), (0.6, 0.5)]))
    assert len(brush) == 2
    assert outlines(drawn("thing", [(0.2, 0.3)])) == []


def test_the_circle_of_a_sphere_goes_through_the_mouse():
    end = (0.6, 0.5)
    (circle,) = outlines(drawn("sphere", [(0.5, 0.5), end], (0.0, 0.0, 0.0)))
    np.testing.assert_allclose(np.abs(circle - end).max(1).min(), 0, atol=1e-9)
    edges = outlines(drawn("box", [(0.5, 0.5), end], (0.0, 0.0, 0.0)))
    assert len(edges) == 12
    behind = drawn("box", [(0.5, 0.5)], (0.0, 0.0, -5.0))  # the eye is inside
    assert len(outlines(behind)) < 12


def test_a_body_without_a_centre_holds_nothing():
    means = np.zeros((3, 3))
    assert not caught(drawn("sphere", [(0.5, 0.5)]), means).any()
    assert not caught(drawn("thing", [(0.5, 0.5)]), means).any()
    assert marks.ON_SCREEN == ("rectangle", "lasso", "brush")
