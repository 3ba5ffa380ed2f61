"""Scores of masks and of peaks."""

import numpy as np
from scipy.ndimage import uniform_filter

from langsplat_core.arrays import Array


def intersection_over_union(found: Array, truth: Array) -> float:
    """Of two (H, W) boolean masks; 1 where both are empty."""
    union = np.logical_or(found, truth).sum()
    return float(np.logical_and(found, truth).sum() / union) if union else 1.0


def majority(mask: Array, window: int = 7) -> Array:
    """(H, W) boolean mask after a `window` x `window` majority vote; a tie is False."""
    return uniform_filter(mask.astype(np.float64), size=window, mode="nearest") > 0.5 + 1e-9
