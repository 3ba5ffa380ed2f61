"""Codecs, which compress CLIP vectors for Gaussians: unit vectors of D numbers to latents of d and back.

They are fitted in `training.language.codec_fit`, and used in plain NumPy, without torch. Callers ask a codec
for what they need (`cosines`, `distances`, `unique`), not which kind it is.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, Self

import numpy as np

from langsplat_core.arrays import Array, check_array, pieces, unit
from langsplat_core.errors import quoted

SHORTEST = 1e-6  # a numeric latent of a smaller norm encodes no vector
MOST_CODEWORDS = 65_535  # indices are 16 bits, and one index stays free for "no codeword"
ROWS = 16_384  # vectors compared with all codewords at a time
LARGEST_SUM = 1e15  # largest activation of a network: its square still fits float32
PAIRS = 65_536  # pairs of latents compared at a time

Layers = tuple[tuple[Array, Array], ...]  # ((out, in) weight, (out,) bias) from input to output


class Codec(ABC):
    """Codec of numeric latents, whose weighted means are latents too; other codecs override more."""

    kind: ClassVar[str]  # name in the scene file
    names: ClassVar[tuple[str, ...]]  # names of the arrays in the scene file, in the order of the fields
    dtype: ClassVar[type[np.generic]] = np.float32  # of latents
    blends: ClassVar[bool] = True  # a weighted mean of latents is a latent
    unit_latents: ClassVar[bool] = False  # latents have length 1: those of 3 numbers lie on a sphere

    def __repr__(self) -> str:
        return f"<{self.kind} codec of {self.size}, for vectors of {self.vector_dim} numbers>"

    @property
    @abstractmethod
    def dims(self) -> tuple[int, int]:
        """Numbers per latent, d, and per vector, D."""

    @property
    def latent_dim(self) -> int:
        """Numbers per latent, d."""
        return self.dims[0]

    @property
    def vector_dim(self) -> int:
        """Numbers per vector, D."""
        return self.dims[1]

    @property
    def size(self) -> int:
        """Size shown beside the kind in reports: numbers per latent, or codewords."""
        return self.latent_dim

    @abstractmethod
    def encode(self, vectors: Array) -> Array:
        """Map (M, D) unit CLIP vectors to (M, d) latents of the codec's type."""

    @abstractmethod
    def decode(self, latents: Array) -> Array:
        """Map (M, d) latents to (M, D) float32 unit vectors."""

    def cosines(self, latents: Array, vectors: Array) -> Array:
        """Return (M, Q) float32 cosines of (M, d) latents and (Q, D) unit vectors; 0 for zero latents."""
        towards, known = _directions(latents)
        return np.where(known[:, None], self.decode(towards) @ vectors.T, 0).astype(np.float32)

    def tensors(self) -> dict[str, Array]:
        """Named weights, as written to the scene file."""
        return dict(zip(self.names, vars(self).values(), strict=True))

    @classmethod
    def from_tensors(cls, tensors: dict[str, Array]) -> Self:
        """Return the inverse of `tensors`; KeyError or ValueError where they do not belong together."""
        return cls(*(tensors[name] for name in cls.names))

    def check(self, latents: Array) -> None:  # noqa: B027  any numbers will do
        """Raise ValueError for (M, d) latents that `encode` cannot return."""

    def known(self, latents: Array) -> Array:
        """Return (M,) bool, False for latents that encode no vector: those of length zero."""
        return np.asarray(np.linalg.norm(latents, axis=1) > SHORTEST)

    def unique(self, latents: Array) -> tuple[Array, Array]:
        """Return (U, d) latents, each once if the codec is discrete, and (M,) int64 indices into them."""
        return latents, np.arange(len(latents))

    def directions(self, latents: Array) -> Array:
        """Return (M, c) float32 unit or zero vectors whose cosines approximate those of decoded latents."""
        return _directions(latents)[0]

    def distances(self, latents: Array, first: Array, second: Array) -> Array:
        """Return (E,) 1 - cosine between the latents at the (E,) indices `first` and `second`."""
        distinct, of = self.unique(latents)
        directions, first, second = self.directions(distinct), of[first], of[second]
        if len(directions) ** 2 <= len(first):
            return np.asarray((1 - directions @ directions.T)[first, second])
        found = np.empty(len(first), np.float32)
        for part in pieces(len(first), PAIRS):  # the vectors may be as long as the encoder's
            found[part] = 1 - np.einsum("ed,ed->e", directions[first[part]], directions[second[part]])
        return found

    def spread(self, latents: Array) -> float:
        """Return the mean distance between two of (M, d) latents: 1 - |mean direction|^2."""
        distinct, of = self.unique(latents)
        mean = np.bincount(of, minlength=len(distinct)) @ self.directions(distinct) / len(latents)
        return max(1 - float(mean @ mean), 0.0)

    def colours(self, latents: Array, weights: Array) -> Array:
        """Return (M, 3) float32 in [0, 1], similar for similar vectors; weights: (M,) counts of each."""
        return principal_colours(latents, weights)


def _directions(latents: Array) -> tuple[Array, Array]:
    """Scale (M, d) latents to length 1, float32; (M,) bool is False for those without a direction."""
    length = np.linalg.norm(latents, axis=1)
    known = length > SHORTEST
    return (latents / np.where(known, length, 1)[:, None]).astype(np.float32), known


@dataclass(frozen=True, eq=False, repr=False)
class LinearCodec(Codec):
    """An orthonormal basis of the scene's CLIP vectors: decoding is one matrix product."""

    basis: Array  # (d, D) float32, orthonormal rows
    kind: ClassVar[str] = "linear"
    names: ClassVar[tuple[str, ...]] = ("basis",)

    def __post_init__(self) -> None:
        check_array("codec basis", self.basis, ("d", "D"), dtype=np.float32)

    @property
    def dims(self) -> tuple[int, int]:
        return self.basis.shape

    def encode(self, vectors: Array) -> Array:
        return np.asarray(vectors, np.float32) @ self.basis.T

    def decode(self, latents: Array) -> Array:
        return unit(np.asarray(latents, np.float32) @ self.basis)

    def cosines(self, latents: Array, vectors: Array) -> Array:
        # cos(B^T l, q) = l.(B q) / |l| for orthonormal rows of B: no (M, D) array is made.
        towards, known = _directions(latents)
        return np.where(known[:, None], towards @ (vectors @ self.basis.T).T, 0).astype(np.float32)


@dataclass(frozen=True, eq=False, repr=False)
class AutoencoderCodec(Codec):
    """LangSplat's autoencoder (section 3.2 of the paper): linear layers with ReLU between; unit latents."""

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
        largest = max(map(_largest, (self.encoder, self.decoder)))
        if LARGEST_SUM < largest < math.inf:  # the file's reader names what is not finite
            raise ValueError(f"codec: the weights add up to {largest:.0e}; at most {LARGEST_SUM:.0e} is used")

    @property
    def dims(self) -> tuple[int, int]:
        return self.decoder[0][0].shape[1], self.encoder[0][0].shape[1]

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

    @classmethod
    def from_tensors(cls, tensors: dict[str, Array]) -> "AutoencoderCodec":
        return cls(_layers(tensors, "encoder"), _layers(tensors, "decoder"))


EPSILON = 1e-5  # added to the variance by batch normalisation, in torch and in LangSplat


def folded(network: Iterable[Mapping[str, Array]]) -> Layers:
    """Return a network's linear layers, float32, each batch normalisation folded into the layer before it.

    network: weights of each layer by their names in torch. ValueError or KeyError for other kinds of layers.
    """
    layers: list[tuple[Array, Array]] = []
    for named in network:
        if "running_var" in named:
            scale = named["weight"] / np.sqrt(named["running_var"] + EPSILON)
            weight, bias = layers[-1]
            shifted = (bias - named["running_mean"]) * scale + named["bias"]
            layers[-1] = (weight * scale[:, None], shifted)
        elif named:
            if named["weight"].ndim != 2:
                raise ValueError(f"a layer with weights {named['weight'].shape}")
            layers.append((named["weight"], named["bias"]))
    return tuple((weight.astype(np.float32), bias.astype(np.float32)) for weight, bias in layers)


def _largest(layers: Layers) -> float:
    """Return an upper bound of the activations of the layers for an input of length 1."""
    bound = 1.0
    for weight, bias in layers:
        bound = float((np.abs(weight).sum(1, dtype=np.float64) * bound + np.abs(bias)).max(initial=0))
    return bound


def _run(layers: Layers, x: Array) -> Array:
    """Return the (M, out) outputs of linear layers, with ReLU between them, for (M, in) inputs."""
    for index, (weight, bias) in enumerate(layers):
        x = x @ weight.T + bias
        if index + 1 < len(layers):
            x = np.maximum(x, 0, out=x)
    return x


def _layers(tensors: dict[str, Array], part: str) -> Layers:
    count = max(sum(name.startswith(f"{part}.") for name in tensors) // 2, 1)
    return tuple((tensors[f"{part}.{i}.weight"], tensors[f"{part}.{i}.bias"]) for i in range(count))


@dataclass(frozen=True, eq=False, repr=False)
class CodebookCodec(Codec):
    """K codewords, unit vectors in CLIP space; a latent is the index of one, so latents cannot be blended."""

    vectors: Array  # (K, D) float32 unit vectors, 1 <= K <= MOST_CODEWORDS
    palette: Array  # (K, 3) float32 in [0, 1]; similar codewords have similar colours
    kind: ClassVar[str] = "codebook"
    names: ClassVar[tuple[str, ...]] = ("vectors", "colours")
    dtype: ClassVar[type[np.generic]] = np.uint16
    blends: ClassVar[bool] = False

    def __post_init__(self) -> None:
        dims = check_array("codec vectors", self.vectors, ("K", "D"), dtype=np.float32)
        check_array("codec colours", self.palette, ("K", 3), dims, dtype=np.float32)
        if not 1 <= dims["K"] <= MOST_CODEWORDS:
            raise ValueError(f"codec vectors: {dims['K']} codewords; 1 to {MOST_CODEWORDS} can be numbered")

    @property
    def dims(self) -> tuple[int, int]:
        return 1, self.vectors.shape[1]

    @property
    def size(self) -> int:
        return len(self.vectors)

    def encode(self, vectors: Array) -> Array:
        nearest = np.empty((len(vectors), 1), np.uint16)
        for part in pieces(len(vectors), ROWS):
            nearest[part, 0] = (np.asarray(vectors[part], np.float32) @ self.vectors.T).argmax(1)
        return nearest

    def decode(self, latents: Array) -> Array:
        return self.vectors[latents[:, 0]]

    def cosines(self, latents: Array, vectors: Array) -> Array:
        if 2 * len(latents) < len(self.vectors):
            return np.asarray(self.decode(latents) @ vectors.T, np.float32)
        return np.asarray(self.vectors @ vectors.T, np.float32)[latents[:, 0]]

    def check(self, latents: Array) -> None:
        if latents.max(initial=0) >= len(self.vectors):
            raise ValueError(f"latents: number {latents.max()} of {len(self.vectors)} codewords")

    def known(self, latents: Array) -> Array:
        return np.ones(len(latents), bool)

    def unique(self, latents: Array) -> tuple[Array, Array]:
        used = np.bincount(latents[:, 0], minlength=1) > 0
        numbers = np.cumsum(used) - 1
        return np.flatnonzero(used).astype(np.uint16)[:, None], numbers[latents[:, 0]]

    def directions(self, latents: Array) -> Array:
        return self.decode(latents)

    def colours(self, latents: Array, weights: Array) -> Array:
        return self.palette[latents[:, 0]]


def principal_colours(vectors: Array, weights: Array) -> Array:
    """Return (K, 3) float32 colours in [0, 1] of (K, c) vectors, similar ones for similar vectors.

    Channels are the first three principal components (the numbers themselves if c = 3) between their 2 % and
    98 % quantiles; 0.5 where missing or constant. weights: (K,) >= 0, of the vectors in both statistics.
    """
    colours = np.full((len(vectors), 3), 0.5, np.float32)
    occurs = np.flatnonzero(weights > 0)
    if len(occurs) == 0:
        return colours
    axes = vectors.astype(np.float64)
    if vectors.shape[1] != 3:
        centred = axes - (weights @ axes) / max(float(weights.sum()), 1e-30)
        scatter = (centred * weights[:, None]).T @ centred
        _, principal = np.linalg.eigh(scatter + 1e-12 * np.eye(axes.shape[1]))
        axes = centred @ principal[:, ::-1][:, :3]
    for axis, values in enumerate(axes.T):
        ends = np.quantile(values[occurs], (0.02, 0.98), weights=weights[occurs], method="inverted_cdf")
        low, high = ends.tolist()
        if high - low > 1e-6:
            colours[:, axis] = np.clip((values - low) / (high - low), 0, 1)
    return colours


KINDS: Mapping[str, type[Codec]] = MappingProxyType(
    {codec.kind: codec for codec in (CodebookCodec, AutoencoderCodec, LinearCodec)}
)


def codec_from_tensors(kind: str, tensors: dict[str, Array]) -> Codec:
    """Rebuild a codec from its kind and named weights; ValueError if they do not belong together."""
    if kind not in KINDS:
        raise ValueError(f"unknown codec kind {quoted(kind)}; known are {', '.join(map(repr, KINDS))}")
    try:
        return KINDS[kind].from_tensors(tensors)
    except KeyError as error:
        raise ValueError(f"{kind} codec without its {error.args[0]}") from None
