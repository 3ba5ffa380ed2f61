"""Files of the original LangSplat and of Gaussian Splatting in torch.

These are features of photographs, the autoencoder, and checkpoints of Gaussian models.

The masks and CLIP vectors of one photograph:

    <stem>_f.npy   float32 (M, D)      one CLIP vector per mask; D = 512, or 3 after its autoencoder
    <stem>_s.npy   integer (4, H, W)   row of `_f` per pixel, -1 where there is no mask; maps in order
                                       default, subpart (s), part (m), whole (l). Floats are read too.

Rows are global: they count on from one map to the next.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.arrays import Array, check_array
from langsplat_core.errors import FormatError
from langsplat_core.extensions.checkpoints.unpickling import plain_array
from langsplat_core.io.files import atomic_path
from langsplat_core.io.hostile import read_npy, write_npy
from langsplat_core.io.ply import REST_COUNTS
from langsplat_core.scene import AutoencoderCodec, Gaussians
from langsplat_core.scene.codec import Layers

MAP_COUNT = 4
NO_MASK = -1


def read_features(folder: Path | str, stem: str) -> tuple[Array, Array]:
    """(M, D) float32 vectors and (4, H, W) int32 rows of them, of the photograph `stem`.

    Raises InputError when a file cannot be opened and FormatError when one breaks a rule.
    """
    vectors_path, maps_path = _paths(folder, stem)
    vectors, maps = read_npy(vectors_path), read_npy(maps_path)
    if vectors.ndim != 2 or vectors.shape[1] < 1 or vectors.dtype.kind != "f":
        raise FormatError(f"{vectors_path}: {vectors.dtype} {vectors.shape}; expected floats of shape (M, D)")
    if not np.isfinite(vectors).all():
        raise FormatError(f"{vectors_path}: holds numbers that are not finite")
    if maps.ndim != 3 or len(maps) != MAP_COUNT or 0 in maps.shape or maps.dtype.kind not in "iuf":
        raise FormatError(f"{maps_path}: {maps.dtype} {maps.shape}; expected numbers of shape (4, H, W)")
    least, greatest = maps.min(), maps.max()
    if not (least >= NO_MASK and greatest < len(vectors)):  # NaN fails both
        raise FormatError(
            f"{maps_path}: ids from {least} to {greatest}; expected {NO_MASK} to {len(vectors) - 1}, "
            f"the rows of {vectors_path.name}"
        )
    rows = maps.astype(np.int32)
    if not np.array_equal(rows, maps):
        raise FormatError(f"{maps_path}: holds ids that are not whole numbers")
    return vectors.astype(np.float32), rows


def write_features(folder: Path | str, stem: str, vectors: Array, maps: Array) -> None:
    """Write both files, the maps last: whoever waits for `_s.npy` finds the vectors it points into."""
    check_array("vectors", vectors, ("M", "D"), dtype=np.float32)
    check_array("maps", maps, (MAP_COUNT, "H", "W"), dtype=np.int32)
    if maps.size and not (maps.min() >= NO_MASK and maps.max() < len(vectors)):
        raise ValueError(f"maps: ids beyond the {len(vectors)} vectors")
    for path, array in zip(_paths(folder, stem), (vectors, maps), strict=True):
        write_npy(path, array)


def _paths(folder: Path | str, stem: str) -> tuple[Path, Path]:
    return Path(folder) / f"{stem}_f.npy", Path(folder) / f"{stem}_s.npy"


# ---- LangSplat's autoencoder, `best_ckpt.pth`: weights by the number of a layer in its network ----
#
#     encoder.{0,3,6,9,12}.{weight,bias}                        linear layers 512-256-128-64-32-3
#     encoder.{1,4,7,10}.{weight,bias,running_mean,running_var} batch normalisation behind all but the last,
#                                                               then ReLU, which has no weights
#     decoder.{0,2,4,6,8,10,12}.{weight,bias}                   linear layers 3-16-32-64-128-256-256-512 with
#                                                               ReLU between them
#
# Both results are scaled to length 1. Other widths and depths are read too: a layer's weights tell what it
# is.

EPSILON = 1e-5  # that batch normalisation adds to the variance
_NAME = re.compile(r"(encoder|decoder)\.([0-9]{1,3})\.(\w+)")
Layer = dict[str, Array]


def is_autoencoder(content: Mapping[Any, Any]) -> bool:
    """Return whether these are weights of an encoder and a decoder."""
    parts = {found[1] for name in content if isinstance(name, str) and (found := _NAME.fullmatch(name))}
    return parts == {"encoder", "decoder"}


def autoencoder_from(content: Mapping[str, Any], path: Path) -> AutoencoderCodec:
    """Return the codec of these weights, batch normalisation folded into the linear layers.

    Raises FormatError.
    """
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


def autoencoder_weights(encoder: Layers, decoder: Layers) -> dict[str, Array]:
    """Return the dictionary of a codec.

    Its batch normalisations change nothing, because theirs are folded in.
    """
    named: dict[str, Array] = {}
    last = len(encoder) - 1
    for number, (weight, bias) in enumerate(encoder):
        named |= {f"encoder.{3 * number}.weight": weight, f"encoder.{3 * number}.bias": bias}
        if number < last:
            ones, zeros = np.ones(len(bias), np.float32), np.zeros(len(bias), np.float32)
            neutral = {"weight": ones, "bias": zeros, "running_mean": zeros}
            neutral |= {
                "running_var": ones - np.float32(EPSILON),
                "num_batches_tracked": np.array(0, np.int64),
            }
            named |= {f"encoder.{3 * number + 1}.{name}": array for name, array in neutral.items()}
    for number, (weight, bias) in enumerate(decoder):
        named |= {f"decoder.{2 * number}.weight": weight, f"decoder.{2 * number}.bias": bias}
    return named


# ---- the tuple of a Gaussian model, as 3D Gaussian Splatting saves it and others extend it ----
#
#     index  element                                        shape
#     0      active SH degree                               whole number
#     1      positions                                      (N, 3)
#     2, 3   SH coefficients: the constant one, the others  (N, 1, 3), (N, K - 1, 3)
#     4      natural logarithms of scales                   (N, 3)
#     5      rotations w x y z, any length                  (N, 4)
#     6      logits of opacities                            (N, 1)
#     7...   what a method adds, then the optimiser's state
#
# It is wrapped as (tuple, iteration). How many elements follow tells nothing: two methods add two each.

GEOMETRY = 7  # elements that every method has


def model_tuple(content: Any) -> tuple[Any, ...] | None:
    """Return the elements of a Gaussian model in what a file holds; None where it is something else."""
    if isinstance(content, (tuple, list)) and len(content) == 2 and isinstance(content[0], (tuple, list)):
        content = content[0]
    if not isinstance(content, (tuple, list)) or len(content) <= GEOMETRY:
        return None
    return tuple(content) if isinstance(content[0], int) else None


def gaussians_of(elements: tuple[Any, ...], path: Path) -> Gaussians:
    """Return the Gaussians in elements 1 to 6.

    Raises FormatError where one has another shape.
    """
    means = _element(elements, 1, (None, 3), "positions (N, 3)", path)
    count = len(means)
    base = _element(elements, 2, (count, 1, 3), f"base colours ({count}, 1, 3)", path)
    rest = _element(elements, 3, (count, None, 3), f"SH coefficients ({count}, K, 3)", path)
    if 3 * rest.shape[1] not in REST_COUNTS:
        raise FormatError(
            f"{path}: {rest.shape[1]} SH coefficients beside the constant; expected 0, 3, 8, 15"
        )
    return Gaussians(
        means,
        _element(elements, 4, (count, 3), f"log scales ({count}, 3)", path),
        _element(elements, 5, (count, 4), f"rotations ({count}, 4)", path),
        _element(elements, 6, (count, 1), f"opacities ({count}, 1)", path)[:, 0],
        np.concatenate([base, rest], axis=1),
    )


def _element(
    elements: tuple[Any, ...], index: int, shape: tuple[int | None, ...], wanted: str, path: Path
) -> Array:
    array = plain_array(elements[index], path)
    if array is None or array.dtype.kind != "f":
        raise FormatError(f"{path}: element {index} holds no {wanted}; is it a checkpoint of Gaussians?")
    fits = array.ndim == len(shape) and all(
        size in (None, actual) for size, actual in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise FormatError(f"{path}: element {index} has the shape {array.shape}; expected {wanted}")
    return np.asarray(array, np.float32)


# Checkpoints as LangSplat and Occam's LGS read them: element 7 holds the features, and what an optimiser
# would need is empty.

ITERATION = 30_000


def write_checkpoint(path: Path, gaussians: Gaussians, features: Array) -> None:
    """Return a level's checkpoint with (N, D) float32 `features`, zero where a Gaussian has no meaning.

    Atomically. It loads with and without `weights_only`.
    """
    import torch

    count = len(gaussians)
    check_array("features", features, (count, "D"), dtype=np.float32)
    nothing = torch.zeros((count, 1))
    elements: tuple[Any, ...] = (
        gaussians.sh_degree,
        _tensor(gaussians.means),
        _tensor(gaussians.sh[:, :1]),
        _tensor(gaussians.sh[:, 1:]),
        _tensor(gaussians.log_scales),
        _tensor(gaussians.quats_wxyz),
        _tensor(gaussians.opacity_logits[:, None]),
        _tensor(features),
        torch.zeros(count),  # largest radii in images
        nothing,  # sums of gradients
        nothing.clone(),  # and how many
        {"state": {}, "param_groups": []},
        1.0,  # the scene's extent, which scales a learning rate
    )
    _save((elements, ITERATION), path)


def write_autoencoder(path: Path, encoder: Layers, decoder: Layers) -> None:
    """`best_ckpt.pth` of a codec, atomically."""
    _save({name: _tensor(array) for name, array in autoencoder_weights(encoder, decoder).items()}, path)


def _tensor(array: Array) -> Any:
    import torch

    return torch.from_numpy(np.array(array, order="C"))  # its own copy: a view would save the whole of it


def _save(content: Any, path: Path) -> None:
    import torch

    with atomic_path(path) as temporary:
        torch.save(content, temporary)
