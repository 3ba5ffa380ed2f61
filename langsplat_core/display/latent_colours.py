"""Colours that show a language field's latents."""

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.scene import LanguageField
from langsplat_core.scene.codec import CodebookCodec, principal_colours


def latent_colours(field: LanguageField) -> Array:
    """(3, N, 3) float32 colours in [0, 1] of the latents at each level; grey where nothing was observed.

    A codeword has its own. Latents of 3 numbers are colours by themselves, others have their first three
    principal axes over all levels together (one basis for the scene, so that colours agree between views
    and levels); each axis is stretched between its 2 % and 98 % quantiles.
    """
    seen = field.known
    if isinstance(field.codec, CodebookCodec):
        colours = field.codec.colours[field.latents[..., 0]]
    else:
        flat = field.latents.reshape(-1, field.latents.shape[2])
        colours = principal_colours(flat, seen.reshape(-1).astype(np.float64)).reshape(*seen.shape, 3)
    return np.where(seen[..., None], colours, np.float32(0.5)).astype(np.float32)
