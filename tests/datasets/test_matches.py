"""The graph of matches: its groups, where photographs are missing, and how that is said."""

import pytest

from langsplat_core.datasets.matches import Matches


def graph(count: int, pairs: list[tuple[int, int, int]], located=(), features: int = 900) -> Matches:
    names = tuple(f"IMG_{number:02d}.jpg" for number in range(count))
    return Matches(names, (features,) * count, tuple(pairs), frozenset(located))


def chain(rows: range, shared: int = 100) -> list[tuple[int, int, int]]:
    return [(a, a + 1, shared) for a in rows[:-1]]


def test_groups_and_the_gaps_between_them():
    matches = graph(12, chain(range(5)) + chain(range(5, 9)) + chain(range(9, 12)) + [(8, 9, 7)], range(5, 9))
    assert matches.groups == [[5, 6, 7, 8], [0, 1, 2, 3, 4], [9, 10, 11]]
    assert matches.gaps() == [(4, 5), (8, 9)]
    assert matches.joined() == (
        "matches join IMG_05.jpg to IMG_08.jpg (4), IMG_00.jpg to IMG_04.jpg (5), "
        "IMG_09.jpg to IMG_11.jpg (3); "
    )
    assert matches.advice() == (
        "take more photographs between IMG_04.jpg and IMG_05.jpg (no matches), "
        "between IMG_08.jpg and IMG_09.jpg (7 matches)"
    )
    assert matches.why(4) == "matches only others that have no camera"


def test_gaps_join_photographs_where_they_match_most():
    matches = graph(5, chain(range(4)) + [(1, 4, 20), (2, 4, 31), (3, 4, 3)], range(4))
    assert matches.gaps() == [(2, 4)]
    assert "without enough overlap" in matches.why(4)


def test_all_from_one_place_are_told_to_step_aside():
    assert "step aside" in graph(4, chain(range(4))).advice()
    assert graph(4, chain(range(4)), range(4)).gaps() == []


@pytest.mark.parametrize("features", [0, 20, -1])
def test_blank_photographs_are_no_gap(features: int):
    matches = graph(4, [], features=features)
    assert matches.gaps() == []
    assert "two thirds" in matches.advice()
    assert matches.why(0) != graph(4, []).why(0)


def test_long_names_of_files_stay_short_in_a_message():
    long = Matches(("a" * 200 + ".jpg", "b.jpg"), (900, 900), (), frozenset({0}))
    assert len(long.advice()) < 120
