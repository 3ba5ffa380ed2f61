"""The relevancy of pixels, in both orders of work, and its peak.

Relevancies of Gaussians are blended, one linear channel per phrase (ours); or latents are blended and then
decoded (the paper's order, section 3.4). Both are gated by alpha, because the zero latent of an uncovered
pixel decodes to a confident something.
"""

import numpy as np
from scipy.ndimage import uniform_filter

from langsplat_core.arrays import Array
from langsplat_core.display.displays import gated_mean
from langsplat_core.errors import InputError
from langsplat_core.raster.protocol import View
from langsplat_core.scene import LanguageField
from langsplat_core.semantics.relevancy import latent_relevancy


def splatted_relevancy(view: View, relevancy: Array, alpha_gate: float) -> Array:
    """Return (H, W, Q) relevancy in [0, 1] of pixels from (N, Q) of Gaussians; 0 under the gate."""
    total, alpha = view.splat(np.asarray(relevancy, np.float32))
    return gated_mean(total, alpha, alpha_gate)


def decoded_relevancy(
    view: View, field: LanguageField, level: int, phrases: Array, alpha_gate: float
) -> Array:
    """Return (H, W, Q) relevancy of the decoded pixel latents for (Q, D) phrase vectors: the paper's order.

    Raises InputError for a codebook, whose numbers cannot be blended.
    """
    if not field.codec.blends:
        raise InputError(
            f"the paper's order blends latents, and this scene has a {field.codec.kind}; train one with "
            "`--codec.kind autoencoder`"
        )
    blended, alpha = view.splat(field.latents[level])
    height, width, d = blended.shape
    flat = np.where(alpha[..., None] > alpha_gate, blended, 0).reshape(-1, d)
    values = latent_relevancy(field.codec, flat, phrases, field.canonical, field.temperature)
    return values.reshape(height, width, len(phrases))


def peak_pixel(relevancy: Array, window: int) -> tuple[int, int, float]:
    """Return the peak (column, row, value) of a relevancy map (H, W) after a mean filter of `window` px.

    The paper's window is 20. It never exceeds the image; borders repeat the edge pixels.
    """
    window = max(1, min(window, *relevancy.shape))
    smooth = uniform_filter(np.asarray(relevancy, np.float64), size=window, mode="nearest")
    row, column = np.unravel_index(int(smooth.argmax()), smooth.shape)
    return int(column), int(row), float(smooth[row, column])
