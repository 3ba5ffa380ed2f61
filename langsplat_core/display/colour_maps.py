"""Colours of numbers and of queries."""

import numpy as np

from langsplat_core.arrays import Array

# Turbo colour map: polynomial fit published by A. Mikhailov, Google (2019), coefficients by channel.
_TURBO_COEFFICIENTS = np.array(
    [
        [0.13572138, 4.61539260, -42.66032258, 132.13108234, -152.94239396, 59.28637943],
        [0.09140261, 2.19418839, 4.84296658, -14.18503333, 4.27729857, 2.82956604],
        [0.10667330, 12.64194608, -60.58204836, 110.36276771, -89.90310912, 27.34824973],
    ]
)
# (256, 3) uint8; looked up with linear interpolation between nodes
TURBO = np.rint(
    255 * np.clip(np.linspace(0, 1, 256)[:, None] ** np.arange(6) @ _TURBO_COEFFICIENTS.T, 0, 1)
).astype(np.uint8)

QUERY_COLOURS = np.array([[0.98, 0.45, 0.09], [0.13, 0.59, 0.95], [0.30, 0.80, 0.35]])  # per shown query
MAX_QUERIES = len(QUERY_COLOURS)  # shown at a time: one colour each, one channel of a texture each


def turbo(t: Array) -> Array:
    """(...,) values in [0, 1] -> (..., 3) colours in [0, 1]."""
    last = len(TURBO) - 1
    position = np.clip(t, 0, 1) * last
    low = np.minimum(position.astype(int), last - 1)
    fraction = (position - low)[..., None]
    table = TURBO / 255.0
    return table[low] * (1 - fraction) + table[low + 1] * fraction
