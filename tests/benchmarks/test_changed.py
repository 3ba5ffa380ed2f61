"""The report of changes: what is done to a room, and what its table counts."""

import numpy as np

from assets.making.dataset import FIRST_ROOM
from assets.making.world import furnished
from langsplat_core.query.changes import Change
from tests.benchmarks.changed import FAR, alter, change_table, judged, middle


def test_eight_things_of_a_room_are_altered_and_the_others_stay():
    placed = furnished(FIRST_ROOM + 9, "clutter")
    altered, done = alter(9, placed)
    assert sorted(one.kind for one in done) == sorted(2 * ["gone", "recoloured", "moved", "appeared"])
    assert len(altered) == len(placed)
    assert len([item for item in altered if item in placed]) == len(placed) - 6
    for one in done:
        here = [np.linalg.norm(middle(item) - np.add(one.centre, one.moved)) for item in altered]
        same = [k for k, away in enumerate(here) if away < 0.01 and altered[k].thing.word == one.word]
        assert bool(same) == (one.kind != "gone")
        assert one.kind != "moved" or np.linalg.norm(one.moved) >= FAR


def test_what_is_said_is_matched_by_kind_and_place():
    _, done = alter(9, furnished(FIRST_ROOM + 9, "clutter"))
    gone = [one for one in done if one.kind == "gone"]
    box = np.zeros((2, 3))
    said = [
        Change("gone", None, np.array(gone[0].centre), box),
        Change("appeared", None, np.array(gone[1].centre), box, pixels=7.0),
    ]
    row = judged(9, "changed", gone, said, 1.0)
    assert (len(row.found), len(row.missed), len(row.false)) == (1, 1, 1)
    assert "| 9 | changed | 2 | 1 |" in change_table([row])
