"""What is painted of an answer follows from its verdict."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from langsplat_core.config import PictureConfig
from langsplat_core.display.displays import QUERY_COLOURS, SEGMENT_OPACITY, Channels, compose
from langsplat_core.query.answers import QueryResult
from langsplat_viewer.actions import queries
from langsplat_viewer.drawing import channels
from langsplat_viewer.output.headless import describe
from langsplat_viewer.panels.overlays import STEPS, bar_colours
from tests.support.windowless import settle


@pytest.fixture
def answers(opened) -> dict[str, QueryResult]:
    """The same answer with each verdict."""
    queries.ask(opened, "mug")
    settle(opened)
    found = opened.state.queries[0].result
    weak = replace(found, found=False, probability=0.7)
    return {"found": found, "weak match": weak, "not here": replace(weak, probability=0.1)}


@pytest.mark.parametrize("display", ["relevancy", "segmentation"])
def test_nothing_is_painted_of_what_is_not_here(answers, display):
    assert channels.columns((answers["not here"],), display, 360) is None
    both = (answers["not here"], answers["found"])
    assert not channels.columns(both, display, 360)[:, 0].any()
    assert channels.columns(both, display, 360)[:, 1].any()
    assert channels.heat_ranges(both, display)[0] == channels.NO_HEAT
    assert not channels.fitted(PictureConfig(), both).own_colours


def test_a_weak_match_is_never_hotter_than_half(answers):
    found, weak = answers["found"], answers["weak match"]
    (low, high), (weak_low, weak_high) = channels.heat_ranges((found, weak), "relevancy")
    assert (low, high) == found.heat_range
    assert (high - weak_low) / (weak_high - weak_low) == pytest.approx(0.5)
    assert channels.fitted(PictureConfig(), (found, weak)).own_colours


def test_a_segmentation_is_made_of_the_members(answers):
    odd = replace(answers["found"], members=np.arange(360) % 7 == 0)  # whatever their relevancy
    assert_allclose(channels.columns((odd,), "segmentation", 360)[:, 0], odd.members)
    assert_allclose(channels.columns((odd,), "relevancy", 360)[:, 0], odd.relevancy[odd.level])


def test_no_coordinates_are_said_of_what_is_not_here(answers):
    assert "place (" in describe(answers["found"])
    assert "place (" in describe(answers["weak match"])
    assert describe(answers["not here"]).endswith("place none")


def pixel(relevancies: tuple[float, ...], **picture) -> np.ndarray:
    """(3,) colour in [0, 1] of one black, opaque pixel."""
    settings = {"display": "relevancy", "heat_opacity": 1.0, "own_colours": True} | picture
    channels = Channels(np.zeros((1, 1, 3)), np.ones((1, 1)), relevancies=np.array([[relevancies]]))
    ranges = ((0.0, 1.0),) * len(relevancies)
    return compose(channels, PictureConfig(**settings), ranges)[0, 0] / 255


def test_heats_that_overlap_mix_their_colours_by_heat():
    assert_allclose(pixel((1.0, 0.0)), QUERY_COLOURS[0], atol=0.003)
    assert_allclose(pixel((0.0, 1.0, 0.0)), QUERY_COLOURS[1], atol=0.003)
    assert_allclose(pixel((1.0, 1.0)), QUERY_COLOURS[:2].mean(0), atol=0.003)
    assert_allclose(pixel((1.0, 0.5)), QUERY_COLOURS[:2].T @ (2 / 3, 1 / 3), atol=0.003)
    assert_allclose(pixel((0.5, 0.0)), 0.5 * QUERY_COLOURS[0], atol=0.003)  # smoothstep of 1/2
    assert_allclose(pixel((0.0, 0.0)), 0)


def test_a_weak_segment_is_half_as_opaque():
    channels = Channels(np.zeros((1, 2, 3)), np.ones((1, 2)), relevancies=np.array([[[1.0, 0], [0, 1.0]]]))
    got = compose(channels, PictureConfig(display="segmentation"), ((0.0, 1.0), (0.0, 2.0)))[0] / 255
    assert_allclose(got, SEGMENT_OPACITY * QUERY_COLOURS[:2] * [[1.0], [0.5]], atol=0.003)


def test_colour_bars_end_where_the_picture_does():
    alone, own, weak = bar_colours(1, 1.0, True), bar_colours(1, 1.0, False), bar_colours(1, 0.5, False)
    assert alone.shape == own.shape == (STEPS, 3)
    assert_allclose(own[[0, -1]], [[0, 0, 0], QUERY_COLOURS[1]])
    assert_allclose(weak[-1], 0.5 * QUERY_COLOURS[1])
    assert alone[-1, 0] > alone[-1, 2]  # red is hot
