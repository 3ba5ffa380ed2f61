"""The scene-wise autoencoder of LangSplat (section 3.2 of the paper), batch normalisation already folded into
the linear layers; latents have length 1."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from langsplat_core.arrays import Array, check_array, unit
from langsplat_core.scene.codec.protocol import LatentSpace, directions

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
