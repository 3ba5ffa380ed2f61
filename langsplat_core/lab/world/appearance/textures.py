"""Procedural surface patterns: functions of the point in the object's own frame, so every view agrees.

Compiled, one point at a time: a photograph asks for about a million points, twice where there is relief.
"""

import math
from functools import cache, partial

import numpy as np
from scipy.ndimage import gaussian_filter

from langsplat_core.arrays import Array
from langsplat_core.compiled import kernel

_SIDE = 64  # samples along one period of the noise
KINDS = (
    "plain", "speckled", "wood", "planks", "cloth", "metal", "pages", "tiles", "plaster", "leaf", "striped",
    "dotted", "rug", "painting", "peel",
)  # fmt: skip
_compiled = partial(kernel, fastmath=True)


@cache
def noise_volume() -> Array:
    """(64, 64, 64) float32 periodic fractal noise, about standard normal."""
    rng = np.random.default_rng(20240624)
    total = np.zeros((_SIDE,) * 3)
    for sigma, weight in ((6, 1.0), (3, 0.6), (1.5, 0.4), (0.7, 0.25)):
        octave = gaussian_filter(rng.standard_normal((_SIDE,) * 3), sigma, mode="wrap")
        total += weight * octave / octave.std()
    return (total / total.std()).astype(np.float32)


@_compiled
def noise_at(volume, x, y, z):  # type: ignore[no-untyped-def]
    """Trilinear look-up; x, y, z in periods."""
    x, y, z = x * _SIDE, y * _SIDE, z * _SIDE
    fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
    u, v, w = x - fx, y - fy, z - fz
    i, j, k = int(fx) & 63, int(fy) & 63, int(fz) & 63
    p, q, r = (i + 1) & 63, (j + 1) & 63, (k + 1) & 63
    near = (volume[i, j, k] * (1 - w) + volume[i, j, r] * w) * (1 - v)
    near += (volume[i, q, k] * (1 - w) + volume[i, q, r] * w) * v
    far = (volume[p, j, k] * (1 - w) + volume[p, j, r] * w) * (1 - v)
    far += (volume[p, q, k] * (1 - w) + volume[p, q, r] * w) * v
    return near * (1 - u) + far * u


@_compiled
def _noise_many(volume, points, out):  # type: ignore[no-untyped-def]
    for n in range(len(points)):
        out[n] = noise_at(volume, points[n, 0], points[n, 1], points[n, 2])


def noise(points: Array, period: float | tuple[float, float, float]) -> Array:
    """(N,) fractal noise, about standard normal, at (N, 3) points; `period` in the points' unit."""
    out = np.empty(len(points))
    _noise_many(noise_volume(), np.ascontiguousarray(points / np.asarray(period)), out)
    return out


@_compiled
def _fraction(value):  # type: ignore[no-untyped-def]
    return value - math.floor(value)


@_compiled
def _scatter(value):  # type: ignore[no-untyped-def]
    """A number in [0, 1) that looks random for every whole `value`."""
    return _fraction(math.sin(value * 12.9898) * 43758.5453)


@_compiled
def _wood(v, x, y, z):  # type: ignore[no-untyped-def]
    """Growth rings about an axis far below the board, and fine pores along the grain (x)."""
    bend = noise_at(v, x / 1.3, y / 0.5, z / 0.5)
    ring = _fraction(math.hypot(y + 0.11, z + 0.5) * 62 + 0.9 * bend)
    band = ring * ring * min(1.0, (1 - ring) * 6)
    pores = noise_at(v, x / 1.1, y / 0.05, z / 0.05)
    return 0.75 * band + 0.13 * pores + 0.2 * bend + 0.1


@_compiled
def _planks(v, x, y, z):  # type: ignore[no-untyped-def]
    row = math.floor(y / 0.14)
    shifted = x + 1.3 * _scatter(row)
    column = math.floor(shifted / 0.95)
    side = abs(_fraction(y / 0.14) - 0.5)
    end = abs(_fraction(shifted / 0.95) - 0.5)
    own = _scatter(row * 7 + column * 3.7)
    if side > 0.482 or end > 0.4972:
        return 2.4
    return 0.9 * own - 0.2 + 0.6 * _wood(v, x + 5 * own, (y - row * 0.14) * 0.8 + own, own)


@_compiled
def _tiles(v, x, y, z):  # type: ignore[no-untyped-def]
    joint = max(abs(_fraction(x / 0.3) - 0.5), abs(_fraction(y / 0.3) - 0.5)) > 0.487
    own = _scatter(math.floor(x / 0.3) + 31 * math.floor(y / 0.3))
    return 1.9 if joint else 0.5 * own - 0.1 + 0.28 * noise_at(v, x / 0.55, y / 0.55, own)


@_compiled
def _cloth(v, x, y, z):  # type: ignore[no-untyped-def]
    a, b, c = math.sin(x * 1300), math.sin(y * 1300), math.sin(z * 1300)
    fibres = noise_at(v, x / 0.045, y / 0.045, z / 0.045)
    broad = noise_at(v, x / 0.17, y / 0.17, z / 0.17)
    return 0.45 + 0.05 * (a * b + b * c + c * a) + 0.15 * fibres + 0.16 * broad


@_compiled
def _rug(v, x, y, z):  # type: ignore[no-untyped-def]
    inside = max(abs(x) / 1.15, abs(y) / 0.95)
    a, b = x / 0.3, y / 0.3
    lattice = abs(a - math.floor(a + 0.5)) + abs(b - math.floor(b + 0.5))
    drawn = (0.82 < inside < 0.9) or (inside < 0.78 and 0.38 < lattice < 0.48)
    pile = 0.09 * noise_at(v, x / 0.06, y / 0.06, z / 0.06) + 0.1 * math.sin(x * 500) * math.sin(y * 500)
    return (0.9 if drawn else 0.05) + pile


@_compiled
def _painting(v, x, y, z):  # type: ignore[no-untyped-def]
    hills = 0.25 + 0.06 * noise_at(v, x / 1.3, 0.0, 0.23)
    front = 0.13 + 0.05 * noise_at(v, x / 0.9, 0.4, 0.71)
    sun = math.hypot(x - 0.12, z - 0.38) < 0.055
    strokes = 0.22 * noise_at(v, x / 0.35, y, z / 0.16)
    return (1.0 if (z < hills) != sun else 0.0) - (0.45 if z < front else 0.0) + strokes


@_compiled
def _small(kind, v, x, y, z):  # type: ignore[no-untyped-def]  # noqa: PLR0911  one row of a table each
    """The patterns of one line each."""
    if kind == 5:  # metal: brushed
        return 0.4 + 0.4 * noise_at(v, x / 0.02, y / 0.02, z / 0.5) + 0.1 * noise_at(v, x / 0.3, y / 0.3, z)
    if kind == 1:  # speckled
        spot = noise_at(v, x / 0.05, y / 0.05, z / 0.05)
        return 1.0 if spot > 1.45 else 0.1 * noise_at(v, x / 0.3, y / 0.3, z / 0.3)
    if kind == 14:  # peel
        pores = noise_at(v, x / 0.05, y / 0.05, z / 0.05)
        return 0.3 * pores + 0.25 * noise_at(v, x / 0.25, y / 0.25, z / 0.25)
    if kind == 6:  # pages
        return (0.8 if math.sin(z * 1900 + y * 500) > 0.5 else 0.0) + 0.1 * noise_at(v, x / 0.1, y / 0.1, z)
    if kind == 9:  # leaf
        return 0.5 + 0.5 * noise_at(v, x / 0.07, y / 0.07, z / 0.07)
    if kind == 10:  # striped
        return 1.1 if _fraction(y / 0.022) > 0.72 else 0.2 * noise_at(v, x / 0.1, y / 0.1, z / 0.1)
    if kind == 8:  # plaster
        return (
            0.4 + 0.08 * noise_at(v, x / 0.16, y / 0.16, z / 0.16) + 0.14 * noise_at(v, x / 2.9, y / 2.3, z)
        )
    a, b, c = x / 0.034, y / 0.034, z / 0.034
    a, b, c = a - math.floor(a + 0.5), b - math.floor(b + 0.5), c - math.floor(c + 0.5)
    return 1.0 if a * a + b * b + c * c < 0.09 else 0.0  # dotted


@_compiled
def weight_at(kind, v, x, y, z):  # type: ignore[no-untyped-def]  # noqa: PLR0911  a table in effect
    """Weight of a material's second colour at a point, metres; `kind`: row of KINDS; `v`: the noise."""
    if kind == 0:
        return 0.16 * noise_at(v, x / 0.25, y / 0.25, z / 0.25)
    if kind == 2:
        return _wood(v, x, y, z)
    if kind == 3:
        return _planks(v, x, y, z)
    if kind == 4:
        return _cloth(v, x, y, z)
    if kind == 7:
        return _tiles(v, x, y, z)
    if kind == 12:
        return _rug(v, x, y, z)
    if kind == 13:
        return _painting(v, x, y, z)
    return _small(kind, v, x, y, z)
