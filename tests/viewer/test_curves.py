"""The curves of camera paths against SciPy's."""

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from langsplat_viewer.camera.curves import cubic, monotone_slopes


@pytest.mark.parametrize("count", [2, 3, 4, 9])
@pytest.mark.parametrize("seed", range(20))
def test_they_are_scipy_s(count, seed):
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.01, 3, count))
    at = np.concatenate([times, rng.uniform(times[0], times[-1], 50)])
    values, slopes = rng.normal(size=(2, count, 3))
    expected = CubicHermiteSpline(times, values, slopes)(at)
    np.testing.assert_allclose(cubic(times, values, slopes, at), expected, atol=1e-10)
    values = np.round(rng.normal(size=count), 1)  # some are equal
    values[:: 1 + seed % 3] += 2.0
    found = cubic(times, values[:, None], monotone_slopes(times, values)[:, None], at)
    np.testing.assert_allclose(found[:, 0], PchipInterpolator(times, values)(at), atol=1e-10)


def test_equal_values_stay():
    times = np.arange(5.0)
    np.testing.assert_array_equal(monotone_slopes(times, np.full(5, 3.0)), 0)
