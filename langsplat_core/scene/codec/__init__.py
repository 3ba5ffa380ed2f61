"""Codecs: how a Gaussian keeps a CLIP vector.

Fitting lives in `training.language`; here are the weights and the maps, so that a scene can be opened and
queried without torch. A new kind is one file and one row of `KINDS`.
"""

from collections.abc import Mapping
from types import MappingProxyType

from langsplat_core.arrays import Array
from langsplat_core.errors import quoted
from langsplat_core.scene.codec.autoencoder import AutoencoderCodec
from langsplat_core.scene.codec.codebook import CodebookCodec, principal_colours
from langsplat_core.scene.codec.linear import LinearCodec
from langsplat_core.scene.codec.protocol import (
    SHORTEST,
    Codec,
    LatentSpace,
    latent_dtype,
    meaningful,
)

__all__ = [
    "KINDS",
    "SHORTEST",
    "AutoencoderCodec",
    "CodebookCodec",
    "Codec",
    "LatentSpace",
    "LinearCodec",
    "codec_from_tensors",
    "latent_dtype",
    "meaningful",
    "principal_colours",
]

KINDS: Mapping[str, type[Codec]] = MappingProxyType(
    {codec.kind: codec for codec in (CodebookCodec, AutoencoderCodec, LinearCodec)}
)


def codec_from_tensors(kind: str, tensors: dict[str, Array]) -> Codec:
    """Rebuild a codec from its kind and named weights; ValueError if they do not belong together."""
    if kind not in KINDS:
        raise ValueError(
            f"unknown codec kind {quoted(kind)}; this version knows {', '.join(map(repr, KINDS))}"
        )
    return KINDS[kind].from_tensors(tensors)
