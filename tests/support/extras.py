"""Further properties of a PLY, one of every type."""

import numpy as np

from langsplat_core.arrays import Array

TYPES = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}


def random_extras(count: int = 40) -> dict[str, Array]:
    """One property of every PLY type, each with its extremes in the first rows."""
    rng = np.random.default_rng(3)
    extras = {}
    for code in TYPES:
        dtype = np.dtype(code)
        values = rng.integers(0, 100, size=count).astype(dtype)
        limits = np.finfo(dtype) if dtype.kind == "f" else np.iinfo(dtype)
        values[:2] = limits.min, limits.max
        extras[f"extra_{code}"] = values
    extras["extra_f4"][2:4] = np.nan, np.inf
    return extras
