"""A second scene beside the first: seen and asked alike, and gone when it is not shown any more."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from langsplat_viewer.actions import editing, opening, queries, settings, viewpoint
from langsplat_viewer.camera.controls import default_view, extent_of, orbit
from tests.support.windowless import SCENES, ask, errors, settle


@pytest.fixture
def two(opened):
    """The blobs, and beside them the same with a phrasebook."""
    ask(opened, "mug")
    opening.open_beside(opened, Path("book.ply"))
    meet(opened)
    yield opened
    if opened.beside is not None:
        opened.beside.worker.close()


def meet(viewer) -> None:
    """Frames until both have done what there is to do."""
    for _ in range(3):
        opening.follow_beside(viewer)
        settle(viewer)
        if viewer.beside is not None:
            settle(viewer.beside)
    opening.follow_beside(viewer)


def test_both_are_seen_and_asked_alike(two):
    other = two.beside.state
    assert other.path == Path("book.ply")
    assert [(query.phrase, query.slot) for query in other.queries] == [("mug", 0)]
    assert other.queries[0].result.found
    assert other.view is two.state.view
    for phrase in ("book", "nothing like this"):
        queries.ask(two, phrase)
    queries.set_level(two, "whole")
    settings.set_display(two, "segmentation")
    settings.resize(two, 77, 55)
    viewpoint.move(two, lambda view: orbit(view, 0.2, 0.1))
    settle(two)
    meet(two)
    assert {query.phrase: query.slot for query in other.queries} == {"mug": 0, "book": 1}
    assert (other.level, other.picture.display, other.size) == ("whole", "segmentation", (77, 55))
    assert other.view is two.state.view
    queries.hide(two, two.state.queries[0])
    queries.remove(two, two.state.queries[1])
    meet(two)
    assert [(query.phrase, query.slot) for query in other.queries] == [("mug", None)]


def test_it_goes_with_the_line_and_does_not_come_back_by_itself(two):
    settings.show_one(two)
    opening.follow_beside(two)
    assert two.beside is None
    editing.undo(two)
    opening.follow_beside(two)
    assert two.state.settings.split.mode == "off"


def test_what_cannot_be_opened_is_said_here(two):
    opening.open_beside(two, Path("broken.ply"))
    meet(two)
    assert "broken.ply" in errors(two)[-1]
    assert two.state.scene is not None


def test_a_scene_without_a_field_shows_its_colours(two):
    opening.open_beside(two, Path("plain.ply"))
    meet(two)
    assert two.beside.state.picture.display == "rgb"
    assert two.beside.state.queries == []
    assert errors(two) == []


def test_other_phrases_to_compare_with_are_those_of_both(two):
    queries.set_canonical(two, "book, plant")
    settle(two)
    meet(two)
    assert two.beside.state.canonical == ("book", "plant")


def test_a_scene_with_other_coordinates_is_seen_from_the_same_side():
    scene = SCENES["blobs.ply"]
    moved = replace(scene.gaussians, means=3 * scene.gaussians.means + 50)
    here, there = extent_of(scene), extent_of(replace(scene, gaussians=moved))
    view = default_view(scene, here, (80, 60))
    other = opening.linked(view, here, there)
    assert opening.linked(view, here, here) is view
    np.testing.assert_array_equal(other.rotation, view.rotation)
    np.testing.assert_allclose(
        (other.eye - there.centre) / there.radius, (view.eye - here.centre) / here.radius
    )
