"""Colours of numbers and of queries."""

from collections.abc import Mapping
from importlib.resources import files
from types import MappingProxyType

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import ColourMap
from langsplat_core.parsing.pictures import opened

# Turbo colour map: polynomial fit published by A. Mikhailov, Google (2019), coefficients by channel.
_TURBO_COEFFICIENTS = np.array(
    [
        [0.13572138, 4.61539260, -42.66032258, 132.13108234, -152.94239396, 59.28637943],
        [0.09140261, 2.19418839, 4.84296658, -14.18503333, 4.27729857, 2.82956604],
        [0.10667330, 12.64194608, -60.58204836, 110.36276771, -89.90310912, 27.34824973],
    ]
)
NODES = 256  # of a colour map; looked up with linear interpolation between them


def _turbo() -> Array:
    powers = np.linspace(0, 1, NODES)[:, None] ** np.arange(6)
    return np.rint(255 * np.clip(powers @ _TURBO_COEFFICIENTS.T, 0, 1)).astype(np.uint8)


def _published() -> dict[ColourMap, Array]:
    """Viridis and magma by N. Smith and S. van der Walt (2015) and cividis by J. Nunez, C. Anderton and
    R. Renslow (2018), as matplotlib has them: the rows of a small picture beside this file."""
    table = files(__package__).joinpath("colour_maps.png").read_bytes()
    with opened(table, "colour_maps.png") as picture:
        rows = np.asarray(picture.convert("RGB"))
    return {"viridis": rows[0], "cividis": rows[1], "magma": rows[2]}


# Name -> (NODES, 3) uint8, in the order of `config.ColourMap`.
COLOUR_MAPS: Mapping[ColourMap, Array] = MappingProxyType(
    {"turbo": _turbo(), **_published(), "grey": np.repeat(np.arange(NODES, dtype=np.uint8)[:, None], 3, 1)}
)
TURBO = COLOUR_MAPS["turbo"]

QUERY_COLOURS = np.array([[0.98, 0.45, 0.09], [0.13, 0.59, 0.95], [0.30, 0.80, 0.35]])  # per shown query
MAX_QUERIES = len(QUERY_COLOURS)  # shown at a time: one colour each, one channel of a texture each


def mapped(t: Array, name: ColourMap = "turbo") -> Array:
    """(...,) values in [0, 1] -> (..., 3) colours in [0, 1] of a colour map."""
    position = np.clip(t, 0, 1) * (NODES - 1)
    low = np.minimum(position.astype(int), NODES - 2)
    fraction = (position - low)[..., None]
    table = COLOUR_MAPS[name] / 255.0
    return table[low] * (1 - fraction) + table[low + 1] * fraction
