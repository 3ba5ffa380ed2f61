"""Codecs between CLIP vectors (D numbers) and latents (d numbers), as plain NumPy inference.

Fitting lives in `training.language.codec_fit`; here are the weights and the two maps, so that a scene can be
opened and queried without torch. Two kinds:

* `AutoencoderCodec`: the scene-wise autoencoder of LangSplat (section 3.2 of the paper), batch
  normalisation already folded into the linear layers; latents have length 1.
* `LinearCodec`: an orthonormal basis; decoding is one matrix product.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, Protocol, Self

import numpy as np

from langsplat_core.arrays import Array, check_array, unit

SHORTEST = 1e-6  # a latent shorter than this has no meaning


class Codec(Protocol):
    """What every codec offers; `kind` names it in the scene file."""

    kind: ClassVar[str]
    unit_latents: ClassVar[bool]  # whether latents have length 1

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

    def similarities(self, latents: Array, vectors: Array) -> Array:
        """(M, d) latents of any length, (Q, D) unit vectors -> (M, Q) float32 cosines of what the latents
        stand for. A blended latent is shorter than its kind but keeps its direction; zero gives zeros."""

    def tensors(self) -> dict[str, Array]:
        """Named weights, as written to the scene file."""

    @classmethod
    def from_tensors(cls, tensors: dict[str, Array]) -> Self:
        """The inverse of `tensors`; ValueError if they do not belong together."""


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
    unit_latents: ClassVar[bool] = True

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

    def similarities(self, latents: Array, vectors: Array) -> Array:
        directions, known = _directions(latents)
        return np.where(known[:, None], self.decode(directions) @ vectors.T, 0).astype(np.float32)

    def tensors(self) -> dict[str, Array]:
        named = {}
        for part, layers in (("encoder", self.encoder), ("decoder", self.decoder)):
            for index, (weight, bias) in enumerate(layers):
                named[f"{part}.{index}.weight"] = weight
                named[f"{part}.{index}.bias"] = bias
        return named

    @classmethod
    def from_tensors(cls, tensors: dict[str, Array]) -> "AutoencoderCodec":
        return cls(_layers(tensors, "encoder"), _layers(tensors, "decoder"))


@dataclass(frozen=True, eq=False)
class LinearCodec:
    """Orthonormal rows spanning the scene's CLIP vectors."""

    basis: Array  # (d, D) float32, orthonormal rows
    kind: ClassVar[str] = "linear"
    unit_latents: ClassVar[bool] = False

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

    def similarities(self, latents: Array, vectors: Array) -> Array:
        # cos(B^T l, q) = l.(B q) / |l| for orthonormal rows of B: the big vectors never appear.
        directions, known = _directions(latents)
        return np.where(known[:, None], directions @ (vectors @ self.basis.T).T, 0).astype(np.float32)

    def tensors(self) -> dict[str, Array]:
        return {"basis": self.basis}

    @classmethod
    def from_tensors(cls, tensors: dict[str, Array]) -> "LinearCodec":
        if "basis" not in tensors:
            raise ValueError("linear codec without its basis")
        return cls(tensors["basis"])


def _directions(latents: Array) -> tuple[Array, Array]:
    """(M, d) float32 latents scaled to length 1, and (M,) whether they have a direction."""
    length = np.linalg.norm(latents, axis=1)
    known = length > SHORTEST
    return (latents / np.where(known, length, 1)[:, None]).astype(np.float32), known


def _layers(tensors: dict[str, Array], part: str) -> Layers:
    count = sum(name.startswith(f"{part}.") for name in tensors) // 2
    try:
        layers = tuple((tensors[f"{part}.{i}.weight"], tensors[f"{part}.{i}.bias"]) for i in range(count))
    except KeyError as error:
        raise ValueError(f"autoencoder codec without {error.args[0]}") from None
    if not layers:
        raise ValueError(f"autoencoder codec without its {part}")
    return layers


KINDS: Mapping[str, type[Codec]] = MappingProxyType(
    {codec.kind: codec for codec in (AutoencoderCodec, LinearCodec)}
)


def codec_from_tensors(kind: str, tensors: dict[str, Array]) -> Codec:
    """Rebuild a codec from its kind and named weights; ValueError if they do not belong together."""
    if kind not in KINDS:
        raise ValueError(f"unknown codec kind {kind!r}; this version knows {' and '.join(map(repr, KINDS))}")
    return KINDS[kind].from_tensors(tensors)
