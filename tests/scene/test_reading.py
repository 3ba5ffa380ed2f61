"""How cosines are read, and which thing a Gaussian belongs to."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.scene import NO_THING, Calibration, Odds, Reading
from tests.support.file_samples import random_field

N = 20


def test_a_probability_is_the_logistic_of_whole_and_the_better_finer_margin():
    odds = Odds(-1.0, 18.0, 3.0)
    for fits in ((0.1, -0.2, 0.3), (-0.2, 0.1, 0.3), (-5.0, -4.0, -9.0)):
        logit = -1 + 18 * fits[2] + 3 * max(fits[:2])
        assert odds.probability(fits) == pytest.approx(1 / (1 + np.exp(-logit)))
    far = odds.probability((-999.0, -999.0, -999.0)), odds.probability((999.0, 999.0, 999.0))
    assert 0 <= far[0] < 1e-9 < 1 - 1e-9 < far[1] <= 1
    assert type(far[0]) is float


@pytest.mark.parametrize(
    "numbers",
    [
        (np.nan, 1, 0, 0.7),
        (0, np.inf, 0, 0.7),
        (0, 1, -np.inf, 0.7),
        (0, 0, 0, 0.7),
        (0, 1, -1, 0.7),
        (0, -2, 1, 0.7),
        (0, 1, 1, 0.49),
        (0, 1, 1, 1.01),
        (0, 1, 1, np.nan),
    ],
)
def test_odds_rise_with_fits(numbers):
    with pytest.raises(ValueError, match="expected finite numbers, rising with fits"):
        Odds(*numbers)


def test_a_reading_holds_a_calibration_or_none():
    assert Reading().calibration is None
    calibration = Calibration(thing=Odds(0, 1, 0), part=Odds(0, 0, 1), inside=Odds(1, 0, 1))
    assert replace(Reading(), calibration=calibration).calibration.part == Odds(0, 0, 1, 0.75)


@pytest.mark.parametrize(
    "things",
    [np.zeros(N - 1, np.uint16), np.zeros((N, 1), np.uint16), np.zeros(N, np.int32), np.zeros(N), [0] * N],
)
def test_things_are_a_number_of_16_bits_each(things):
    with pytest.raises((ValueError, TypeError), match="things"):
        replace(random_field(N), things=things)


def test_taking_rows_takes_their_things():
    field = replace(random_field(N), things=np.arange(N, dtype=np.uint16))
    field.things[3] = NO_THING
    mask = np.arange(N) % 2 == 1
    for rows in (np.array([5, 3, 3, 0]), mask, np.zeros(0, int)):
        taken = field.take(rows)
        np.testing.assert_array_equal(taken.things, field.things[rows])
        assert (len(taken), taken.things.dtype) == (len(field.things[rows]), np.uint16)
    assert random_field(N).take(mask).things is None
