"""What every codec offers: two maps between CLIP vectors (D numbers) and latents (d numbers), in plain
NumPy."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, Literal, Protocol, Self

import numpy as np

from langsplat_core.arrays import Array, check_array, unit
from langsplat_core.errors import quoted

SHORTEST = 1e-6  # a latent of numbers shorter than this has no meaning

# sphere: latents have length 1; flat: any vector is one; in both, a blend lies between what was blended.
# index: a latent is one whole number that names a meaning, and numbers between two names mean nothing.
LatentSpace = Literal["sphere", "flat", "index"]


class Codec(Protocol):
    """What every codec offers; `kind` names it in the scene file."""

    kind: ClassVar[str]
    space: ClassVar[LatentSpace]

    @property
    def latent_dim(self) -> int:
        """d"""

    @property
    def vector_dim(self) -> int:
        """D"""

    @property
    def index_size(self) -> int:
        """Meanings that an index may name, counted from 0; 0 where latents are numbers."""

    def encode(self, vectors: Array) -> Array:
        """(M, D) unit CLIP vectors -> (M, d) latents, float32 or, of an index, uint16."""

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


def latent_dtype(codec: type[Codec] | Codec) -> type[np.generic]:
    """Of the latents of `codec`."""
    return np.uint16 if codec.space == "index" else np.float32


def meaningful(codec: Codec, latents: Array) -> Array:
    """(M, d) latents -> (M,) whether each stands for anything: a zero vector of numbers does not."""
    if codec.space == "index":
        return np.ones(len(latents), bool)
    known: Array = np.linalg.norm(latents, axis=1) > SHORTEST
    return known


def directions(latents: Array) -> tuple[Array, Array]:
    """(M, d) float32 latents scaled to length 1, and (M,) whether they have a direction."""
    length = np.linalg.norm(latents, axis=1)
    known = length > SHORTEST
    return (latents / np.where(known, length, 1)[:, None]).astype(np.float32), known


# An orthonormal basis: decoding is one matrix product, and a cosine needs not even that.


@dataclass(frozen=True, eq=False)
class LinearCodec:
    """Orthonormal rows spanning the scene's CLIP vectors."""

    basis: Array  # (d, D) float32, orthonormal rows
    kind: ClassVar[str] = "linear"
    index_size: ClassVar[int] = 0
    space: ClassVar[LatentSpace] = "flat"

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
        towards, known = directions(latents)
        return np.where(known[:, None], towards @ (vectors @ self.basis.T).T, 0).astype(np.float32)

    def tensors(self) -> dict[str, Array]:
        return {"basis": self.basis}

    @classmethod
    def from_tensors(cls, tensors: dict[str, Array]) -> "LinearCodec":
        if "basis" not in tensors:
            raise ValueError("linear codec without its basis")
        return cls(tensors["basis"])


# The scene-wise autoencoder of LangSplat (section 3.2 of the paper), batch normalisation already folded into
# the linear layers; latents have length 1.

Layers = tuple[tuple[Array, Array], ...]  # ((out, in) weight, (out,) bias) from input to output


@dataclass(frozen=True, eq=False)
class AutoencoderCodec:
    """Multi-layer perceptrons in both directions, with ReLU between layers and unit-length outputs."""

    encoder: Layers
    decoder: Layers
    kind: ClassVar[str] = "autoencoder"
    index_size: ClassVar[int] = 0
    space: ClassVar[LatentSpace] = "sphere"

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
        towards, known = directions(latents)
        return np.where(known[:, None], self.decode(towards) @ vectors.T, 0).astype(np.float32)

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


def _run(layers: tuple[tuple[Array, Array], ...], x: Array) -> Array:
    """Linear layers with ReLU between them; weights are (out, in)."""
    for index, (weight, bias) in enumerate(layers):
        x = x @ weight.T + bias
        if index + 1 < len(layers):
            x = np.maximum(x, 0, out=x)
    return x


def _layers(tensors: dict[str, Array], part: str) -> Layers:
    count = sum(name.startswith(f"{part}.") for name in tensors) // 2
    try:
        layers = tuple((tensors[f"{part}.{i}.weight"], tensors[f"{part}.{i}.bias"]) for i in range(count))
    except KeyError as error:
        raise ValueError(f"autoencoder codec without {error.args[0]}") from None
    if not layers:
        raise ValueError(f"autoencoder codec without its {part}")
    return layers


# A scene's own codebook: K unit vectors in CLIP space, and a latent is the number of one of them.
#
# A scene means a countable number of things. A phrase costs one (K, D) product and a fetch per Gaussian, and
# what is fetched is an exact cosine with a vector of CLIP's own space: nothing is decoded.

LARGEST = 65_535  # codewords: indices are 16 bits, and one number stays free for "no meaning"
ROWS = 16_384  # vectors compared with all codewords at a time


@dataclass(frozen=True, eq=False)
class CodebookCodec:
    """Codewords, and a colour for each by which people tell them apart."""

    vectors: Array  # (K, D) float32 unit vectors, 1 <= K <= LARGEST
    colours: Array  # (K, 3) float32 in [0, 1]; near codewords have near colours
    kind: ClassVar[str] = "codebook"
    space: ClassVar[LatentSpace] = "index"
    latent_dim: ClassVar[int] = 1

    def __post_init__(self) -> None:
        dims = check_array("codec vectors", self.vectors, ("K", "D"), dtype=np.float32)
        check_array("codec colours", self.colours, ("K", 3), dims, dtype=np.float32)
        if not 1 <= dims["K"] <= LARGEST:
            raise ValueError(f"codec vectors: {dims['K']} codewords; from 1 to {LARGEST} can be numbered")

    @property
    def index_size(self) -> int:
        return len(self.vectors)

    @property
    def vector_dim(self) -> int:
        return int(self.vectors.shape[1])

    def encode(self, vectors: Array) -> Array:
        nearest = np.empty((len(vectors), 1), np.uint16)
        for start in range(0, len(vectors), ROWS):
            part = slice(start, start + ROWS)
            nearest[part, 0] = (np.asarray(vectors[part], np.float32) @ self.vectors.T).argmax(1)
        return nearest

    def decode(self, latents: Array) -> Array:
        return self.vectors[latents[:, 0]]

    def similarities(self, latents: Array, vectors: Array) -> Array:
        cosines: Array = (self.vectors @ vectors.T).astype(np.float32)[latents[:, 0]]
        return cosines

    def tensors(self) -> dict[str, Array]:
        return {"vectors": self.vectors, "colours": self.colours}

    @classmethod
    def from_tensors(cls, tensors: dict[str, Array]) -> "CodebookCodec":
        missing = {"vectors", "colours"} - set(tensors)
        if missing:
            raise ValueError(f"codebook codec without its {' and '.join(sorted(missing))}")
        return cls(tensors["vectors"], tensors["colours"])


def principal_colours(vectors: Array, weights: Array) -> Array:
    """(K, c) vectors of any meaning -> (K, 3) float32 colours in [0, 1]: their first three principal axes,
    each stretched between its 2 % and 98 % quantiles; an axis that is missing or flat is grey.

    weights: (K,) >= 0, how often each occurs; the axes and quantiles are those of what occurs.
    """
    if vectors.shape[1] != 3:
        vectors = _principal(vectors.astype(np.float64), weights)
    return stretched(vectors, weights)


def stretched(axes: Array, weights: Array) -> Array:
    """(K, 3) numbers -> (K, 3) float32 in [0, 1], every axis between its weighted 2 % and 98 % quantiles."""
    colours = np.full(axes.shape, 0.5)
    occurs = np.flatnonzero(weights > 0)
    if len(occurs) == 0:
        return colours.astype(np.float32)
    for axis in range(3):
        values = axes[:, axis].astype(np.float64)
        low, high = _quantiles(values[occurs], weights[occurs])
        if high - low > 1e-6:
            colours[:, axis] = np.clip((values - low) / (high - low), 0, 1)
    return colours.astype(np.float32)


def _principal(vectors: Array, weights: Array) -> Array:
    total = max(float(weights.sum()), 1e-30)
    centred = vectors - (weights @ vectors) / total
    _, axes = np.linalg.eigh((centred * weights[:, None]).T @ centred + 1e-12 * np.eye(vectors.shape[1]))
    projected = centred @ axes[:, ::-1][:, :3]
    return np.pad(projected, ((0, 0), (0, 3 - projected.shape[1])))


def _quantiles(values: Array, weights: Array) -> tuple[float, float]:
    order = np.argsort(values, kind="stable")
    below = np.cumsum(weights[order], dtype=np.float64)
    low, high = np.searchsorted(below, np.array([0.02, 0.98]) * below[-1]).clip(max=len(order) - 1)
    return float(values[order[low]]), float(values[order[high]])


# Codecs: how a Gaussian keeps a CLIP vector.
#
# Fitting lives in `training.language`; here are the weights and the maps, so that a scene can be opened and
# queried without torch. A new kind is one file and one row of `KINDS`.

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
