"""What pictures depend on: one value, and another one for every change that is seen."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_viewer import staging
from langsplat_viewer.actions import queries, selecting, settings, viewpoint
from langsplat_viewer.canvas import Canvas
from langsplat_viewer.rendering.depth import Clip, LastView, Sight, Splats
from langsplat_viewer.rendering.renderer import GlRenderer
from langsplat_viewer.staging import Depiction, depiction
from langsplat_viewer.viewer import Viewer
from tests.support.fakes import blob_scene
from tests.support.windowless import settle


def depicted(viewer: Viewer) -> Depiction:
    return depiction(viewer.state, staging.shown_pictures(viewer.state))


CHANGES = {
    "display": lambda v: settings.set_display(v, "depth"),
    "slider": lambda v: settings.set_picture(v, replace(v.state.picture, dim=0.1)),
    "hidden query": lambda v: queries.hide(v, v.state.queries[0]),
    "cut": lambda v: queries.set_cut(v, v.state.queries[0], 0.7),
    "split": settings.toggle_wipe,
    "splats": lambda v: settings.set_splats(v, Splats(0.5)),
    "near cut": lambda v: settings.set_clip(v, Clip(1.0)),
    "marks": selecting.select_all,
    "size": lambda v: settings.resize(v, 300, 200),
    "view": lambda v: viewpoint.look_from(v, "left"),
}
UNSEEN = {
    "line": lambda v: settings.move_line(v, 0.3),
    "ruler": settings.toggle_measuring,
    "tool": lambda v: selecting.use_tool(v, "brush"),
    "word": lambda v: queries.type_phrase(v, "plant"),
    "chosen query": lambda v: queries.select(v, None),
}


@pytest.fixture
def asked(opened: Viewer) -> Viewer:
    queries.ask(opened, "mug")
    settle(opened)
    settings.resize(opened, 240, 180)
    return opened


@pytest.mark.parametrize("name", CHANGES)
def test_what_is_seen_is_in_it(asked, name):
    before = depicted(asked)
    assert depicted(asked) == before
    CHANGES[name](asked)
    viewpoint.tick(asked, asked.clock + 10)
    viewpoint.tick(asked, asked.clock + 10)
    assert depicted(asked) != before


@pytest.mark.parametrize("name", UNSEEN)
def test_what_is_not_seen_is_not_in_it(asked, name):
    before = depicted(asked)
    UNSEEN[name](asked)
    assert depicted(asked) == before


def test_a_sight_is_equal_where_the_picture_is():
    scene = blob_scene()
    first, second, _ = scene.cameras
    sight = Sight(scene, first)
    assert sight == Sight(scene, replace(first, name="again"))
    assert hash(sight) == hash(Sight(scene, replace(first, name="again")))
    others = (
        Sight(scene, second),
        Sight(scene, first, Clip(1.0)),
        Sight(replace(scene), first),
        Sight(scene, replace(first, width=80)),
    )
    assert all(sight != other for other in others)


class CountingRasterizer:
    name = "counting"

    def __init__(self) -> None:
        self.views = 0

    def view(self, gaussians, camera, settings=None):
        self.views += 1
        return self.views


def test_a_view_is_kept_while_the_sight_is_the_same():
    scene, rasterizer = blob_scene(), CountingRasterizer()
    views = LastView(rasterizer)
    sights = [Sight(scene, scene.cameras[place]) for place in (0, 0, 1, 1, 0)]
    assert [views.of(sight) for sight in sights] == [1, 1, 2, 2, 3]
    views.forget()
    assert views.of(sights[0]) == 4


@pytest.mark.parametrize("backend", ["opengl", "cpu"])
@pytest.mark.parametrize("name", CHANGES)
def test_what_is_kept_gives_the_picture_that_a_new_renderer_gives(gl, asked, name, backend):
    kept, fresh = GlRenderer(gl, backend), GlRenderer(gl, backend)
    canvas = Canvas(gl, kept)
    canvas.update(asked.state, 0.0)
    CHANGES[name](asked)
    viewpoint.tick(asked, asked.clock + 10)
    viewpoint.tick(asked, asked.clock + 10)
    canvas.update(asked.state, 20.0)
    canvas.update(asked.state, 30.0)
    expected = Canvas(gl, fresh).capture(asked.state)
    np.testing.assert_array_equal(canvas.capture(asked.state), expected)
    kept.release()
    fresh.release()
