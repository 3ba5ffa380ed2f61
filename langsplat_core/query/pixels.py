"""Relevancy of pixels, in both orders.

`decode-first` (ours): relevancy is looked up per Gaussian and splatted, one linear channel per phrase.
`paper` (LangSplat section 3.4): latents are splatted, every pixel's blend is decoded, then compared.
Both are gated by alpha, because an uncovered pixel's zero latent decodes to a confident something.
"""

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.display.compose import gated_mean
from langsplat_core.errors import InputError
from langsplat_core.raster.protocol import View
from langsplat_core.scene import LanguageField
from langsplat_core.semantics.relevancy import latent_relevancy


def splatted_relevancy(view: View, relevancy: Array, alpha_gate: float) -> Array:
    """(N, Q) per-Gaussian relevancy -> (H, W, Q) per-pixel relevancy in [0, 1]; 0 under the gate."""
    total, alpha = view.splat(np.asarray(relevancy, np.float32))
    return gated_mean(total, alpha, alpha_gate)


def decoded_relevancy(
    view: View, field: LanguageField, level: int, phrases: Array, alpha_gate: float
) -> Array:
    """The paper's order: (Q, D) phrase vectors -> (H, W, Q) relevancy of the decoded pixel latents.

    Raises InputError for a codebook, whose numbers cannot be blended.
    """
    if field.codec.space == "index":
        raise InputError(
            "the paper's order blends latents, and this scene has a codebook; train one with "
            "`--codec.kind autoencoder`"
        )
    blended, alpha = view.splat(field.latents[level])
    height, width, d = blended.shape
    flat = np.where(alpha[..., None] > alpha_gate, blended, 0).reshape(-1, d)
    values = latent_relevancy(field.codec, flat, phrases, field.canonical, field.reading.temperature)
    return values.reshape(height, width, len(phrases))
