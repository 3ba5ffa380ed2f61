"""Codecs between CLIP vectors (D numbers) and latents (d numbers), as plain NumPy inference.

Fitting lives in `training.codec_fit`; here are the weights and the two maps, so that a scene can be
opened and queried without torch. Two kinds:

* `AutoencoderCodec`: the scene-wise autoencoder of LangSplat (section 3.2 of the paper), batch
  normalisation already folded into the linear layers; latents have length 1.
* `LinearCodec`: an orthonormal basis; decoding is one matrix product.
"""

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from langsplat_core.arrays import Array, check_array, unit


class Codec(Protocol):
    """What every codec offers; `kind` names it in the scene file."""

    kind: ClassVar[str]

    @property
    def latent_dim(self) -> int:
        """d"""

    @property
    def vector_dim(self) -> int:
        """D"""

    def encode(self, vectors: Array) -> Array:
        """(M, D) unit CLIP vectors -> (M, d) float32 latents."""

    def decode(self, latents: Array) -> Array:
        """(M, d) latents -> (M, D) float32 unit vectors."""

    def tensors(self) -> dict[str, Array]:
        """Named weights, as written to the scene file."""


def _run(layers: tuple[tuple[Array, Array], ...], x: Array) -> Array:
    """Linear layers with ReLU between them; weights are (out, in)."""
    for index, (weight, bias) in enumerate(layers):
        x = x @ weight.T + bias
        if index + 1 < len(layers):
            x = np.maximum(x, 0, out=x)
    return x


Layers = tuple[tuple[Array, Array], ...]  # ((out, in) weight, (out,) bias) from input to output


@dataclass(frozen=True, eq=False)
class AutoencoderCodec:
    """Multi-layer perceptrons in both directions, with ReLU between layers and unit-length outputs."""

    encoder: Layers
    decoder: Layers
    kind: ClassVar[str] = "autoencoder"

    def __post_init__(self) -> None:
        for name, layers in (("encoder", self.encoder), ("decoder", self.decoder)):
            width = layers[0][0].shape[1]
            for weight, bias in layers:
                check_array(f"codec {name} weight", weight, ("out", width), dtype=np.float32)
                check_array(f"codec {name} bias", bias, (weight.shape[0],), dtype=np.float32)
                width = weight.shape[0]
        if self.encoder[-1][0].shape[0] != self.latent_dim or self.decoder[-1][0].shape[0] != self.vector_dim:
            raise ValueError("codec: the decoder does not mirror the encoder's widths")

    @property
    def latent_dim(self) -> int:
        return int(self.decoder[0][0].shape[1])

    @property
    def vector_dim(self) -> int:
        return int(self.encoder[0][0].shape[1])

    def encode(self, vectors: Array) -> Array:
        return unit(_run(self.encoder, np.asarray(vectors, np.float32)))

    def decode(self, latents: Array) -> Array:
        return unit(_run(self.decoder, np.asarray(latents, np.float32)))

    def tensors(self) -> dict[str, Array]:
        named = {}
        for part, layers in (("encoder", self.encoder), ("decoder", self.decoder)):
            for index, (weight, bias) in enumerate(layers):
                named[f"{part}.{index}.weight"] = weight
                named[f"{part}.{index}.bias"] = bias
        return named


@dataclass(frozen=True, eq=False)
class LinearCodec:
    """Orthonormal rows spanning the scene's CLIP vectors."""

    basis: Array  # (d, D) float32, orthonormal rows
    kind: ClassVar[str] = "linear"

    def __post_init__(self) -> None:
        check_array("codec basis", self.basis, ("d", "D"), dtype=np.float32)

    @property
    def latent_dim(self) -> int:
        return int(self.basis.shape[0])

    @property
    def vector_dim(self) -> int:
        return int(self.basis.shape[1])

    def encode(self, vectors: Array) -> Array:
        return np.asarray(vectors, np.float32) @ self.basis.T

    def decode(self, latents: Array) -> Array:
        return unit(np.asarray(latents, np.float32) @ self.basis)

    def tensors(self) -> dict[str, Array]:
        return {"basis": self.basis}


def codec_from_tensors(kind: str, tensors: dict[str, Array]) -> Codec:
    """Rebuild a codec from its kind and named weights; ValueError if they do not belong together."""
    if kind == LinearCodec.kind:
        if "basis" not in tensors:
            raise ValueError("linear codec without its basis")
        return LinearCodec(tensors["basis"])
    if kind != AutoencoderCodec.kind:
        raise ValueError(f"unknown codec kind {kind!r}; this version knows 'autoencoder' and 'linear'")
    parts: dict[str, Layers] = {}
    for part in ("encoder", "decoder"):
        count = sum(name.startswith(f"{part}.") for name in tensors) // 2
        try:
            parts[part] = tuple(
                (tensors[f"{part}.{i}.weight"], tensors[f"{part}.{i}.bias"]) for i in range(count)
            )
        except KeyError as error:
            raise ValueError(f"autoencoder codec without {error.args[0]}") from None
        if not parts[part]:
            raise ValueError(f"autoencoder codec without its {part}")
    return AutoencoderCodec(parts["encoder"], parts["decoder"])
