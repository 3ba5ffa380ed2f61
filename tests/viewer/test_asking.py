"""Own cuts, canonical phrases and sets of queries, without a window."""

import json
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.errors import InputError
from langsplat_core.scene import CANONICAL_PHRASES
from langsplat_viewer.actions import opening, queries, undoing
from langsplat_viewer.files.browsing import QuerySet, SavedQuery, read_queries, write_queries
from langsplat_viewer.panels.search import BINS, histogram
from tests.support.windowless import errors, settle


@pytest.fixture
def asked(opened):
    """Three blobs, and "mug" asked."""
    queries.ask(opened, "mug")
    settle(opened)
    return opened


def test_an_answer_ends_where_one_says_and_can_end_by_itself_again(asked):
    (query,) = asked.state.queries
    automatic = query.result
    assert automatic.own_cut is None
    assert 0 < automatic.members.sum() < 360
    key = asked.state.layers_key()
    for cut in (0.0, float(np.median(automatic.even)), 1.1):
        queries.set_cut(asked, query, cut)
        assert query.result.cut == cut
        np.testing.assert_array_equal(query.result.members, automatic.even >= np.float32(cut))
        assert query.result.heat_range[0] <= min(cut, automatic.peak)
    assert asked.state.layers_key() != key
    queries.set_cut(asked, query, None)
    assert query.result is automatic


def test_a_cut_is_undone_in_one_step_and_outlives_another_level(asked):
    (query,) = asked.state.queries
    automatic = query.result
    queries.set_cut(asked, query, 0.6)
    for value in (0.61, 0.62):  # the slider moves on
        queries.set_cut(asked, query, value, is_new=False)
    queries.set_level(asked, "part")
    settle(asked)
    assert (query.result.level, query.result.own_cut) == (1, 0.62)
    undoing.undo(asked)
    settle(asked)
    assert query.result.own_cut == 0.62
    undoing.undo(asked)
    settle(asked)
    assert query.result.own_cut is None
    np.testing.assert_array_equal(query.result.members, automatic.members)
    undoing.redo(asked)
    assert query.result.own_cut == 0.62


def test_the_cut_of_an_answer_is_the_least_relevancy_in_it(asked):
    result = asked.state.queries[0].result
    assert result.cut == result.even[result.members].min()


def test_everything_can_be_compared_with_other_phrases(asked):
    (query,) = asked.state.queries
    before = query.result
    queries.set_canonical(asked, "book, plant")
    settle(asked)
    assert asked.state.canonical == ("book", "plant")
    assert asked.engine.canonical_phrases == ("book", "plant")
    assert np.abs(query.result.relevancy - before.relevancy).max() > 0.01
    assert query.result.probability is None
    queries.set_canonical(asked, "sofa")  # never taught: all stays as it was
    settle(asked)
    assert "sofa" in errors(asked)[-1]
    assert asked.state.canonical == ("book", "plant")
    queries.set_canonical(asked, "")
    settle(asked)
    assert asked.state.canonical == ()
    assert asked.engine.canonical_phrases == CANONICAL_PHRASES
    np.testing.assert_array_equal(query.result.relevancy, before.relevancy)


def test_a_set_of_queries_is_asked_again(asked, tmp_path):
    queries.set_cut(asked, asked.state.queries[0], 0.7)
    queries.ask(asked, "plant")
    settle(asked)
    queries.hide(asked, asked.state.queries[1])
    queries.set_level(asked, "whole")
    queries.set_canonical(asked, "book")
    settle(asked)
    path = queries.save_queries(asked, tmp_path)
    assert path.name == "blobs-001.queries.json"
    opening.open_scene(asked, Path("blobs.ply"))
    settle(asked)
    assert (asked.state.queries, asked.state.canonical) == ([], ())
    opening.open_dropped(asked, [path])
    settle(asked)
    found = [(query.phrase, query.cut, query.slot is None) for query in asked.state.queries]
    assert found == [("mug", 0.7, False), ("plant", None, True)]
    assert asked.state.canonical == ("book",)
    assert asked.state.level == "whole"
    assert asked.state.queries[0].result.own_cut == 0.7


def test_queries_dropped_with_a_scene_are_asked_of_it(viewer, tmp_path):
    path = tmp_path / "a.queries.json"
    write_queries(path, QuerySet((SavedQuery("mug"),)))
    opening.open_dropped(viewer, [path, Path("blobs.ply")])
    settle(viewer)
    assert [query.phrase for query in viewer.state.queries] == ["mug"]


def test_nothing_to_save_and_nothing_to_ask_of(viewer, opened, tmp_path):
    assert queries.save_queries(opened, tmp_path) is None
    queries.load_queries(opened, tmp_path / "gone.queries.json")
    assert "gone.queries.json" in errors(opened)[-1]
    opening.open_scene(opened, Path("plain.ply"))
    settle(opened)
    write_queries(tmp_path / "a.queries.json", QuerySet((SavedQuery("mug"),)))
    queries.load_queries(opened, tmp_path / "a.queries.json")
    assert "searched" in errors(opened)[-1]
    queries.set_canonical(opened, "book")
    assert "language field" in errors(opened)[-1]
    assert opened.state.queries == []


GOOD = {"format": "langsplat-queries", "queries": [{"phrase": "mug"}]}


@pytest.mark.parametrize(
    "change",
    [
        {"format": "other"},
        {"queries": "mug"},
        {"queries": ["mug"]},
        {"queries": [{"phrase": ""}]},
        {"queries": [{"phrase": 3}]},
        {"queries": [{"phrase": "x" * 2000}]},
        {"queries": [{"phrase": "mug", "cut": 2}]},
        {"queries": [{"phrase": "mug", "cut": True}]},
        {"queries": [{"phrase": "mug", "cut": float("nan")}]},
        {"queries": [{"phrase": "mug", "shown": 1}]},
        {"queries": [{"phrase": "mug"}] * 201},
        {"level": "floor"},
        {"level": []},
        {"canonical": "book"},
        {"canonical": [""]},
    ],
)
def test_a_broken_set_is_one_line(tmp_path, change):
    path = tmp_path / "a.queries.json"
    path.write_text(json.dumps(GOOD))
    assert read_queries(path) == QuerySet((SavedQuery("mug"),))
    path.write_text(json.dumps(GOOD | change))
    with pytest.raises(InputError, match="no set of queries") as caught:
        read_queries(path)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"\xff\xfe", b"[" * 200_000, b"{}"])
def test_what_is_no_set_at_all_is_one_line(tmp_path, content):
    path = tmp_path / "a.queries.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match="no set of queries"):
        read_queries(path)


def test_the_histogram_counts_every_gaussian(asked):
    low, high, counts = histogram(asked.state.queries[0].result)
    even = asked.state.queries[0].result.even
    assert (low, high) == (even.min(), max(even.max(), low + 1e-3))
    assert len(counts) == BINS
    assert np.expm1(counts.astype(np.float64)).sum() == pytest.approx(360, rel=1e-5)
