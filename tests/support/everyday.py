"""Everyday phrases of encoders that know a few axes."""

import numpy as np

from langsplat_core.arrays import Array, unit

COUNT = 64


def everyday_about(canonical: Array, spread: float = 0.2, seed: int = 8) -> Array:
    """(64, D) float32 unit vectors around a (D,) canonical phrase: nothing in particular fits them."""
    noise = np.random.default_rng(seed).normal(scale=spread, size=(COUNT, len(canonical)))
    return unit(canonical + noise).astype(np.float32)
