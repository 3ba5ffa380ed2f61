"""Phrases with structure that are true of a procedural room; names and inventories against its truth."""

import numpy as np
import pytest

from assets.making.dataset import write_labels
from assets.making.truth import Region, Truth, read_truth
from assets.making.world import World, build_room
from langsplat_core.query.compose import upright, viewpoint
from langsplat_core.query.describe import Entry, Spot
from langsplat_core.query.grammar import Atom, parse
from langsplat_core.scene import look_at
from tests.benchmarks.phrases import (
    CONSTRUCTIONS,
    Case,
    InventoryScore,
    cases,
    score_inventory,
    things_in,
)

UP = np.array([0.0, 0.0, 1.0])
FRAME = upright(UP)


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> tuple[World, Truth]:
    world = build_room(3, "separate")
    folder = tmp_path_factory.mktemp("room") / "truth"
    folder.mkdir()
    write_labels(world, folder / "labels.json")
    return world, read_truth(folder.parent)


@pytest.fixture(scope="module")
def found(room) -> list[Case]:
    world, truth = room
    camera = look_at(np.array([0.0, -2.0, 1.0]), np.zeros(3), UP, (160, 120))
    return cases(truth, things_in(world, FRAME), viewpoint(camera, FRAME), 0)


def test_things_are_where_the_room_has_them(room):
    world, _ = room
    things = things_in(world, FRAME)
    table = things.extents[things.called("table")[0]]
    assert table.high[2] == pytest.approx(0, abs=0.02)  # the origin is the middle of the table's top
    assert len(things.called("wall")) == 4
    assert set(things.called("furniture")) > set(things.called("chair"))


@pytest.mark.long
def test_every_case_has_structure_and_a_truth_that_says_so(room, found):
    _, truth = room
    assert {case.construction for case in found} <= set(CONSTRUCTIONS)
    assert {"part of thing", "A and B", "kind, not thing", "near", "highest"} <= {
        c.construction for c in found
    }
    known = set(truth.regions)
    for case in found:
        assert set(case.ids) | set(case.without) <= known
        # "picture of a cat" is a picture, and a part that is in no list is asked whole
        assert "part" in case.construction or not isinstance(parse(case.text), Atom)


TRUTH = {
    0: Region("whole", "mug", "mug", words=("mug", "cup", "red mug")),
    1: Region("whole", "table", "table", words=("table",)),
    2: Region("whole", "duck", "duck", words=("duck",)),
}
LABELS = np.stack([np.repeat([-1, -1, -1, -1], 30), np.repeat([-1] * 4, 30), np.repeat([0, 1, 2, -1], 30)])


def entry(phrase: str, rows: range, level: int = 2) -> Entry:
    spot = Spot(np.zeros(3), np.zeros((2, 3)), np.array(rows), 0.1, None, None)
    return Entry(phrase, (), level, 0.9, 0.9, 0.1, (spot,))


def test_an_entry_is_true_where_most_of_its_surface_is():
    entries = [
        entry("cup", range(35)),  # the mug, and a little of the table
        entry("duck", range(50, 70)),  # half the table
        entry("lamp", range(60, 90)),  # the duck
        entry("table", range(30, 60), level=1),  # no whole thing
    ]
    score = score_inventory(entries, LABELS, TRUTH, np.ones(120), ["cup", "duck", "table"])
    assert score == InventoryScore(entries=3, true=1 / 3, things=3, named=1 / 3, seconds=0.0)


def test_things_without_a_word_in_the_vocabulary_do_not_count():
    areas = np.ones(120)
    areas[:30] = 10
    score = score_inventory([entry("mug", range(60))], LABELS, TRUTH, areas, ["mug"])
    assert (score.true, score.things, score.named) == (1, 1, 1)
    assert score_inventory([], LABELS, TRUTH, areas, []).named == 0
