"""LangSplat's autoencoder, `best_ckpt.pth`: a dictionary of weights by the number of a layer in its network.

    encoder.{0,3,6,9,12}.{weight,bias}                        linear layers 512-256-128-64-32-3
    encoder.{1,4,7,10}.{weight,bias,running_mean,running_var} batch normalisation behind all but the last,
                                                              then ReLU, which has no weights
    decoder.{0,2,4,6,8,10,12}.{weight,bias}                   linear layers 3-16-32-64-128-256-256-512 with
                                                              ReLU between them

Both results are scaled to length 1. Other widths and depths are read too: a layer's weights tell what it is.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError
from langsplat_core.formats.checkpoints.unpickling import plain_array
from langsplat_core.scene import AutoencoderCodec

EPSILON = 1e-5  # that batch normalisation adds to the variance
_NAME = re.compile(r"(encoder|decoder)\.(\d{1,3})\.(\w+)")
Layer = dict[str, Array]


def is_autoencoder(content: Mapping[Any, Any]) -> bool:
    """Whether these are weights of an encoder and a decoder."""
    parts = {found[1] for name in content if isinstance(name, str) and (found := _NAME.fullmatch(name))}
    return parts == {"encoder", "decoder"}


def autoencoder_from(content: Mapping[str, Any], path: Path) -> AutoencoderCodec:
    """The codec of these weights, batch normalisation folded into the linear layers. Raises FormatError."""
    try:
        with np.errstate(all="ignore"):  # what is not finite is refused below
            codec = AutoencoderCodec(
                *(_folded(_layers(content, part, path)) for part in ("encoder", "decoder"))
            )
    except (ValueError, KeyError, IndexError, TypeError) as error:
        raise FormatError(f"{path}: not an autoencoder of LangSplat's kind ({error})") from None
    if not all(np.isfinite(tensor).all() for tensor in codec.tensors().values()):
        raise FormatError(f"{path}: the autoencoder's weights are not finite; it was trained to nothing")
    return codec


def _layers(content: Mapping[str, Any], part: str, path: Path) -> list[Layer]:
    """Named weights of every layer that has any, in the network's order."""
    layers: dict[int, Layer] = {}
    for name, value in content.items():
        found = _NAME.fullmatch(name) if isinstance(name, str) else None
        array = plain_array(value, path) if found and found[1] == part else None
        if found and array is not None:
            layers.setdefault(int(found[2]), {})[found[3]] = array.astype(np.float64)
    return [layers[number] for number in sorted(layers)]


def _folded(layers: list[Layer]) -> tuple[tuple[Array, Array], ...]:
    """Linear layers as (out, in) float32 weights and (out,) biases; what follows one is made part of it."""
    folded: list[tuple[Array, Array]] = []
    for layer in layers:
        weight, bias = layer["weight"], layer["bias"]
        if "running_var" in layer:
            scale = weight / np.sqrt(layer["running_var"] + EPSILON)
            before, offset = folded[-1]
            folded[-1] = (before * scale[:, None], (offset - layer["running_mean"]) * scale + bias)
        elif weight.ndim == 2:
            folded.append((weight, bias))
        else:
            raise ValueError(f"a layer with weights {weight.shape}")
    return tuple((weight.astype(np.float32), bias.astype(np.float32)) for weight, bias in folded)


def autoencoder_weights(codec: AutoencoderCodec) -> dict[str, Array]:
    """The dictionary of a codec; its batch normalisations change nothing, because theirs are folded in."""
    named: dict[str, Array] = {}
    last = len(codec.encoder) - 1
    for number, (weight, bias) in enumerate(codec.encoder):
        named |= {f"encoder.{3 * number}.weight": weight, f"encoder.{3 * number}.bias": bias}
        if number < last:
            ones, zeros = np.ones(len(bias), np.float32), np.zeros(len(bias), np.float32)
            neutral = {"weight": ones, "bias": zeros, "running_mean": zeros}
            neutral |= {
                "running_var": ones - np.float32(EPSILON),
                "num_batches_tracked": np.array(0, np.int64),
            }
            named |= {f"encoder.{3 * number + 1}.{name}": array for name, array in neutral.items()}
    for number, (weight, bias) in enumerate(codec.decoder):
        named |= {f"decoder.{2 * number}.weight": weight, f"decoder.{2 * number}.bias": bias}
    return named
