"""Procedural surface colour: a function of the point in the object's own frame, so every view agrees."""

from functools import cache

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from langsplat_core.arrays import Array
from langsplat_core.datasets.synthetic.parts import Material

_SIDE = 64  # samples along one period of the noise


@cache
def _noise_volume() -> Array:
    """(64, 64, 64) float32 periodic fractal noise, about standard normal."""
    rng = np.random.default_rng(20240624)
    total = np.zeros((_SIDE,) * 3)
    for sigma, weight in ((6, 1.0), (3, 0.6), (1.5, 0.4), (0.7, 0.25)):
        octave = gaussian_filter(rng.standard_normal((_SIDE,) * 3), sigma, mode="wrap")
        total += weight * octave / octave.std()
    return (total / total.std()).astype(np.float32)


def noise(points: Array, period: float | tuple[float, float, float]) -> Array:
    """(N,) fractal noise, about standard normal, at (N, 3) points; `period` in the points' unit."""
    cells = (points / np.asarray(period) * _SIDE).T
    return map_coordinates(_noise_volume(), cells, order=1, mode="grid-wrap")


def _ring_wave(value: Array) -> Array:
    """Saw-tooth of period 1 with a soft edge, in [0, 1]."""
    phase = value - np.floor(value)
    return np.where(phase < 0.85, phase / 0.85, (1 - phase) / 0.15)


def _wood(p: Array) -> Array:
    wobble = noise(p, (1.1, 0.28, 0.28))
    return 0.55 * _ring_wave((p[:, 1] * 9 + p[:, 2] * 7) + 0.5 * wobble) + 0.16 * noise(p, (0.7, 0.03, 0.03))


def _planks(p: Array) -> Array:
    row = np.floor(p[:, 1] / 0.17)
    along = p[:, 0] + 0.43 * row
    joint = (np.abs(p[:, 1] / 0.17 - row - 0.5) > 0.48) | (
        np.abs(along / 1.1 - np.floor(along / 1.1) - 0.5) > 0.496
    )
    shade = np.sin(12.9898 * row + 78.233 * np.floor(along / 1.1)) * 0.45
    grain = noise(np.stack([p[:, 0], p[:, 1] + 3.1 * row, p[:, 2]], 1), (1.2, 0.12, 0.4))
    return np.where(joint, 2.6, 0.45 + shade + 0.35 * grain)


def _tiles(p: Array) -> Array:
    cell = p[:, :2] / 0.3
    joint = (np.abs(cell - np.floor(cell) - 0.5) > 0.485).any(1)
    shade = 0.5 * np.sin(np.floor(cell) @ (12.9898, 78.233) * 43.7)
    return np.where(joint, 2.4, 0.4 + shade + 0.3 * noise(p, 0.5))


def _cloth(p: Array) -> Array:
    angle = np.arctan2(p[:, 1], p[:, 0]) * 0.12
    weave = np.sin((angle + p[:, 0]) * 900) * np.sin((p[:, 2] + p[:, 1]) * 900)
    return 0.45 + 0.4 * weave + 0.35 * noise(p, 0.12)


def _rug(p: Array) -> Array:
    inside = np.maximum(np.abs(p[:, 0]) / 1.15, np.abs(p[:, 1]) / 0.95)
    border = (inside > 0.82) & (inside < 0.9)
    lattice = np.abs(p[:, 0] / 0.3 - np.round(p[:, 0] / 0.3)) + np.abs(
        p[:, 1] / 0.3 - np.round(p[:, 1] / 0.3)
    )
    return np.where(
        border | ((inside < 0.78) & (lattice > 0.38) & (lattice < 0.48)), 1.0, 0.12 * noise(p, 0.05)
    )


def _painting(p: Array) -> Array:
    hills = 0.25 + 0.06 * noise(np.stack([p[:, 0], 0 * p[:, 0], 0 * p[:, 0] + 0.3], 1), 1.3)
    sun = np.hypot(p[:, 0] - 0.12, p[:, 2] - 0.38) < 0.055
    return np.where((p[:, 2] < hills) ^ sun, 1.0, 0.0) + 0.25 * noise(p, 0.6)


def _mix(material: Material, p: Array) -> Array:
    """(N,) weight of the second colour at (N, 3) points; outside [0, 1] it extrapolates a little."""
    kind = material.texture
    if kind == "wood":
        return _wood(p)
    if kind == "planks":
        return _planks(p)
    if kind == "tiles":
        return _tiles(p)
    if kind == "cloth":
        return _cloth(p)
    if kind == "rug":
        return _rug(p)
    if kind == "painting":
        return _painting(p)
    if kind == "metal":
        return 0.4 + 0.5 * noise(p, (0.02, 0.02, 0.5))
    if kind == "speckled":
        return np.where(noise(p, 0.035) > 1.3, 1.1, 0.12 * noise(p, 0.3))
    if kind == "peel":
        return 0.25 * noise(p, 0.025) + 0.2 * noise(p, 0.2)
    if kind == "pages":
        return np.where(np.sin(p[:, 2] * 1900 + p[:, 1] * 500) > 0.5, 0.9, 0.0) + 0.1 * noise(p, 0.1)
    if kind == "leaf":
        return 0.5 + 0.6 * noise(p, 0.06)
    if kind == "striped":
        return np.where(_ring_wave(p[:, 1] / 0.022) > 0.8, 1.2, 0.2 * noise(p, 0.1))
    if kind == "dotted":
        cell = p / 0.034
        return (np.linalg.norm(cell - np.round(cell), axis=1) < 0.3).astype(np.float64)
    if kind == "plaster":
        return 0.4 + 0.3 * noise(p, (0.41, 0.37, 0.39)) + 0.5 * noise(p, (2.9, 2.3, 2.6))
    return 0.15 * noise(p, 0.25)


def surface_colour(material: Material, points: Array) -> Array:
    """(N, 3) sRGB display colours in [0, 1] of a material at (N, 3) points in the object's frame."""
    weight = np.clip(_mix(material, points), -0.4, 1.6)[:, None]
    return np.clip(material.colour + weight * (material.second - material.colour), 0, 1)
