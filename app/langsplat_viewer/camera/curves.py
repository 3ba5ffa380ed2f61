"""Cubic curves through values at given times. SciPy's are the same, and bring 12 MB of modules along."""

import numpy as np

from langsplat_core.arrays import Array


def cubic(times: Array, values: Array, slopes: Array, at: Array) -> Array:
    """(T, D) of the piecewise cubic with (K, D) values and slopes at (K,) ascending times, at (T,) within."""
    row = np.clip(np.searchsorted(times, at, "right") - 1, 0, len(times) - 2)
    steps = np.diff(times)[row][:, None]
    u = (at - times[row])[:, None] / steps
    start, end = values[row], values[row + 1]
    bend = u * (1 - u) * steps * ((1 - u) * slopes[row] - u * slopes[row + 1])
    return start + u**2 * (3 - 2 * u) * (end - start) + bend


def monotone_slopes(times: Array, values: Array) -> Array:
    """(K,) slopes at (K,) ascending times with which `cubic` stays between neighbouring (K,) values: those of
    Fritsch and Butland (1984)."""
    steps = np.diff(times)
    rates = np.diff(values) / steps
    if len(rates) == 1:
        return np.repeat(rates, 2)
    slopes = np.zeros(len(values))
    inner = rates[:-1] * rates[1:] > 0
    before, after = (2 * steps[1:] + steps[:-1])[inner], (steps[1:] + 2 * steps[:-1])[inner]
    slopes[1:-1][inner] = (before + after) / (before / rates[:-1][inner] + after / rates[1:][inner])
    slopes[0] = _end_slope(steps[0], steps[1], rates[0], rates[1])
    slopes[-1] = _end_slope(steps[-1], steps[-2], rates[-1], rates[-2])
    return slopes


def _end_slope(step: float, next_step: float, rate: float, next_rate: float) -> float:
    """Of the parabola through three values at their end, as far as the curve stays monotone."""
    slope = ((2 * step + next_step) * rate - step * next_rate) / (step + next_step)
    if slope * rate <= 0:
        return 0.0
    return 3 * rate if rate * next_rate < 0 and abs(slope) > 3 * abs(rate) else slope
