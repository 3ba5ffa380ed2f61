"""Phrases with structure that are true of a procedural room."""

import json

import numpy as np
import pytest

from langsplat_core.lab.rooms.phrase_cases import CONSTRUCTIONS, Case, cases, things_in
from langsplat_core.lab.rooms.phrases import PhraseScore, phrase_table
from langsplat_core.lab.rooms.truth import Truth, read_truth
from langsplat_core.lab.world.assembly import World, build_room
from langsplat_core.query.compose import upright, viewpoint
from langsplat_core.query.grammar import Atom, parse
from langsplat_core.scene import look_at

UP = np.array([0.0, 0.0, 1.0])
FRAME = upright(UP)


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> tuple[World, Truth]:
    world = build_room(3, "separate")
    folder = tmp_path_factory.mktemp("room") / "truth"
    folder.mkdir()
    names = ("subpart", "part", "whole")
    items = {
        str(number): {
            **{key: getattr(label, key) for key in ("word", "thing", "colour", "phrase", "words")},
            "level": names[label.level],
        }
        for number, label in enumerate(world.labels)
    }
    (folder / "labels.json").write_text(json.dumps(items))
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
def test_what_is_on_the_table_is_above_its_top(room, found):
    things = things_in(room[0], FRAME)
    rows = [case for case in found if case.construction == "on" and case.text.endswith("the table")]
    for case in rows:
        assert all(things.extents[number].low[2] > -0.05 for number in case.ids)


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


def test_what_is_taken_away_is_no_longer_true():
    case = Case("thing without part", "mug without its handle", "mug", (2,), (5,))
    labels = np.array([[[0, 5, 9]], [[1, 5, 9]], [[2, 2, 3]]])
    np.testing.assert_array_equal(case.mask(labels), [[True, False, False]])


def test_the_table_pairs_whole_and_composed():
    row = PhraseScore(
        "A and B", "mug and book", "whole", 1, True, False, (0.25, 0.75), (True, False), 0.5, 0.1
    )
    absent = PhraseScore("A and B", "mug and oak", "whole", 1, False, False, (), (), float("nan"), 0.1)
    rows = [
        row,
        absent,
        PhraseScore("A and B", "mug and book", "composed", 1, True, True, (1.0, 1.0), (True, True), 1.0, 0.1),
    ]
    assert (
        "| A and B | 1 | 2 | 50.0 / 100.0 | 50.0 / 100.0 | 50.0 / 100.0 | 0.0 / 100.0 | 100.0 / - |"
        in phrase_table(rows)
    )
