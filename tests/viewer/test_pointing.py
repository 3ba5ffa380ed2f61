"""What is said beside the cursor, without a window."""

from pathlib import Path

import pytest

from langsplat_core.query.describe import Describer, look_at_pixel
from langsplat_core.query.engine import QueryEngine
from langsplat_core.raster import load_lifting_rasterizer
from langsplat_viewer.actions import opening, queries, settings, viewpoint
from langsplat_viewer.panels.overlays import pointed_figures, said
from tests.support.fakes import CENTRES, FakeEncoder, blob_scene
from tests.support.windowless import errors, settle


@pytest.fixture(scope="module")
def compiled() -> None:
    """The kernels that look at a pixel: half a minute on a fresh machine."""
    engine = QueryEngine(blob_scene(), lambda encoder_id: FakeEncoder())
    camera = engine.scene.cameras[0].resized(16, 12)
    look_at_pixel(load_lifting_rasterizer("cpu"), Describer(engine, ("mug",)), camera, (8, 6))


@pytest.fixture
def pointing(compiled, opened):
    """The mug asked for, and the mouse asked about."""
    settings.resize(opened, 160, 120)
    queries.ask(opened, "mug")
    settle(opened)
    viewpoint.toggle_pointing(opened)
    return opened


def at(viewer, thing: int) -> tuple[int, int]:
    (x, y), _ = (part[0] for part in viewer.state.view.camera(160, 120).project(CENTRES[thing][None]))
    return int(x), int(y)


def rest(viewer, pixel, seconds: float = 0.5) -> None:
    """The mouse lies still there."""
    began = viewer.clock
    for now in (began, began + seconds):
        viewpoint.tick(viewer, now)
        viewpoint.hover(viewer, pixel)
    settle(viewer)


def test_it_is_said_once_the_mouse_rests(pointing):
    rest(pointing, at(pointing, 0), seconds=0.05)
    assert pointing.state.hover.found is None
    rest(pointing, at(pointing, 0))
    found = pointing.state.hover
    assert found.phrases == ("mug",)
    assert found.found.relevancy[0] > 0.9
    assert "mug" in said(found.found.words[2], sure=False)
    assert "%" not in said(found.found.words[2], sure=False)
    assert "mug 100 %" in said(found.found.words[2], sure=True)
    assert "away" in pointed_figures(found)[-1]
    assert pointed_figures(found)[0].startswith("mug: ")


def test_it_is_forgotten_when_the_mouse_or_the_camera_moves(pointing):
    rest(pointing, at(pointing, 0))
    viewpoint.hover(pointing, (3, 4))
    assert pointing.state.hover.found is None
    rest(pointing, at(pointing, 1))
    assert pointing.state.hover.found is not None
    viewpoint.step_camera(pointing, 1)
    for now in (10.0, 11.0):
        viewpoint.tick(pointing, now)
    viewpoint.hover(pointing, at(pointing, 1))
    assert pointing.state.hover.found is None
    for elsewhere in (None, (-1, 5), (160, 5), (5, 120)):
        viewpoint.hover(pointing, elsewhere)
        assert pointing.state.hover is None


def test_the_words_are_read_once_for_a_scene(pointing):
    rest(pointing, at(pointing, 0))
    describer = pointing.describer
    rest(pointing, at(pointing, 1))
    assert pointing.describer is describer
    opening.open_scene(pointing, Path("book.ply"))
    settle(pointing)
    assert (pointing.describer, pointing.state.hover, pointing.state.pointing) == (None, None, True)


def test_a_scene_that_means_nothing_says_so(pointing):
    opening.open_scene(pointing, Path("plain.ply"))
    settle(pointing)
    assert not pointing.state.pointing
    viewpoint.toggle_pointing(pointing)
    assert not pointing.state.pointing
    assert "langsplat train" in errors(pointing)[-1]
