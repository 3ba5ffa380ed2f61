"""How coarse pictures are while the camera moves."""

import pytest

from langsplat_viewer.drawing.renderer import FINE, MOVING_BUDGET, Level, Pace

HALF, QUARTER = Level(0.5), Level(0.25)
MERGED, COARSEST = Level(0.5, merged=True), Level(0.25, merged=True)


def after(*pictures: tuple[Level, float]) -> Pace:
    pace = Pace()
    for level, milliseconds in pictures:
        pace.drew(level, milliseconds)
    return pace


@pytest.mark.parametrize(
    ("fine_ms", "plain", "with_merged"),
    [
        (0, FINE, FINE),
        (MOVING_BUDGET, FINE, FINE),
        (150, HALF, HALF),
        (600, QUARTER, MERGED),
        (1e5, QUARTER, COARSEST),
    ],
)
def test_first_guess(fine_ms, plain, with_merged):
    pace = after((FINE, fine_ms))
    assert (pace.level(False), pace.level(True)) == (plain, with_merged)
    assert pace.is_slow == (fine_ms > MOVING_BUDGET)


def test_a_level_that_was_too_slow_is_left():
    pace = after((FINE, 150))
    assert pace.level(True) == HALF
    pace.drew(HALF, 120)  # hardly faster: projecting takes as long for few pixels
    assert pace.level(True) == MERGED


def test_one_slow_picture_among_fast_ones_is_forgiven():
    pace = after((FINE, 150), (HALF, 20), (HALF, 20), (HALF, 60))
    assert pace.level(True) == HALF


def test_what_was_learned_follows_the_fine_picture():
    """The same scene on a machine that became free: everything takes a quarter."""
    pace = after((FINE, 150), (HALF, 120))
    assert pace.level(True) != HALF
    pace.drew(FINE, 38)
    assert pace.level(True) == FINE


def test_better_is_tried_again_after_some_rests():
    pace = after((FINE, 150), (HALF, 70))
    assert pace.level(True) == MERGED
    for _ in range(3):
        pace.drew(FINE, 150)
    assert pace.level(True) == HALF


def test_other_scenes_take_as_long_as_they_are_large():
    pace = Pace()
    pace.expect(1000)
    assert not pace.is_slow
    pace.expect(1_000_000)  # guessed
    assert pace.is_slow
    pace.drew(FINE, 1000)
    pace.expect(100_000)
    assert pace.level(False) == HALF
    pace.expect(50_000)
    assert pace.level(False) == FINE


def test_only_merged_gaussians_stand_in():
    assert after((FINE, 300)).stand_in() == MERGED
    assert after((FINE, 2000)).stand_in() == COARSEST
    assert after((FINE, 1e5)).stand_in() is None
