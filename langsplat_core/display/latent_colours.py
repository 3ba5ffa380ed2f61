"""Colours that show a language field's latents."""

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.scene import LanguageField


def latent_colours(field: LanguageField) -> Array:
    """(3, N, 3) float32 colours in [0, 1] of the latents at each level.

    For d = 3 the axes are the latent's own; otherwise the first three principal axes of all levels
    together (one basis for the scene, so that colours agree between views and levels; missing axes
    show grey). Each axis is stretched between its 2 % and 98 % quantiles. Unobserved Gaussians: grey.
    """
    levels, count, d = field.latents.shape
    latents = field.latents.reshape(-1, d).astype(np.float64)
    seen = field.confidence.reshape(-1) > 0
    if d != 3:
        centred = latents - latents[seen].mean(0) if seen.any() else latents
        _, axes = np.linalg.eigh(centred[seen].T @ centred[seen] + 1e-12 * np.eye(d))
        latents = centred @ axes[:, ::-1][:, :3]
        latents = np.pad(latents, ((0, 0), (0, 3 - latents.shape[1])))
    colours = np.full_like(latents, 0.5)
    if seen.any():
        low, high = np.quantile(latents[seen], [0.02, 0.98], axis=0)
        span = high - low
        stretched = (latents[seen] - low) / np.maximum(span, 1e-6)
        colours[seen] = np.where(span > 1e-6, np.clip(stretched, 0, 1), 0.5)
    return colours.reshape(levels, count, 3).astype(np.float32)
