"""Words beside things: none covers another, and they stay where they are while nothing meets."""

from itertools import combinations

import numpy as np
import pytest

from langsplat_viewer.camera.overlays import Label, placed

PICTURE = (400.0, 300.0)


def random_labels(seed: int, count: int) -> list[Label]:
    rng = np.random.default_rng(seed)
    return [
        Label(*map(float, rng.uniform((-20, -20), (420, 320))), float(rng.uniform(20, 90)), 18.0)
        for _ in range(count)
    ]


@pytest.mark.parametrize("seed", range(30))
def test_none_covers_another_and_all_are_in_the_picture(seed):
    found = placed(random_labels(seed, 25), PICTURE)
    assert not any(a.covers(b) for a, b in combinations(found, 2))
    for label in found:
        assert 0 <= label.x <= PICTURE[0] - label.width
        assert 0 <= label.y <= PICTURE[1] - label.height


def test_what_meets_nothing_stays_and_the_first_one_always_does():
    wanted = [Label(10, 100, 50, 20), Label(61, 100, 50, 20), Label(30, 110, 50, 20)]
    found = placed(wanted, PICTURE)
    assert found[:2] == wanted[:2]
    assert found[2] == Label(30, 80, 50, 20)  # straight up


def test_at_the_top_they_go_down():
    wanted = [Label(10, 0, 50, 20), Label(10, 5, 50, 20), Label(10, 8, 50, 20)]
    assert [label.y for label in placed(wanted, PICTURE)] == [0, 20, 40]


def test_where_there_is_no_room_they_stay():
    wanted = [Label(0, 0, 50, 20), Label(0, 3, 50, 20), Label(0, 6, 50, 20)]
    assert [label.y for label in placed(wanted, (50, 45))] == [0, 20, 6]


def test_small_moves_move_labels_as_little_until_two_meet():
    """Things that drift by a tenth of a pixel a frame: labels follow, but for a jump where two meet."""
    start, rng = random_labels(3, 8), np.random.default_rng(0)
    drift = rng.uniform(-0.1, 0.1, (8, 2))
    before, jumps = placed(start, PICTURE), 0
    for frame in range(1, 400):
        moved = [
            Label(label.x + frame * float(dx), label.y + frame * float(dy), label.width, label.height)
            for label, (dx, dy) in zip(start, drift, strict=True)
        ]
        after = placed(moved, PICTURE)
        jumps += sum(abs(a.y - b.y) > 0.25 for a, b in zip(before, after, strict=True))
        before = after
    assert jumps <= 8
