"""Files of the original LangSplat and of Gaussian Splatting in torch: autoencoders, Gaussian models."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.arrays import Array, check_array
from langsplat_core.errors import FormatError, InputError
from langsplat_core.extensions.checkpoints.unpickling import plain_array
from langsplat_core.io.files import atomic_path
from langsplat_core.io.ply import REST_COUNTS
from langsplat_core.io.scenes import ORIGIN_SUFFIX, Exporter, companion_path, write_origin
from langsplat_core.progress import Progress, silent
from langsplat_core.scene import LEVELS, NO_ORIGIN, AutoencoderCodec, Gaussians, Scene
from langsplat_core.scene.codec import EPSILON, Layers, folded

# ---- LangSplat's autoencoder, `best_ckpt.pth`: weights by the number of a layer in its network ----
#
#     encoder.{0,3,6,9,12}.{weight,bias}                        linear layers 512-256-128-64-32-3
#     encoder.{1,4,7,10}.{weight,bias,running_mean,running_var} batch normalisation after all but the last,
#                                                               then ReLU, which has no weights
#     decoder.{0,2,4,6,8,10,12}.{weight,bias}                   linear layers 3-16-32-64-128-256-256-512 with
#                                                               ReLU between them
#
# Both outputs are scaled to length 1. Other widths and depths are read too, from the weights of the layers.

_NAME = re.compile(r"(encoder|decoder)\.([0-9]{1,3})\.(\w+)")
LATENT = 3  # numbers per Gaussian that its rasterizer is compiled for
Layer = dict[str, Array]


def is_autoencoder(content: Mapping[Any, Any]) -> bool:
    """Return True if the content is weights of an encoder and a decoder."""
    parts = {found[1] for name in content if (found := layer_name(name))}
    return parts == {"encoder", "decoder"}


def layer_name(name: object) -> re.Match[str] | None:
    """Return the match of part, layer number and kind in the name of weights; None for another entry."""
    return _NAME.fullmatch(name) if isinstance(name, str) else None


def autoencoder_from(content: Mapping[str, Any], path: Path) -> AutoencoderCodec:
    """Return the codec of these weights, batch normalisation folded into the linear layers.

    Raises FormatError.
    """
    try:
        with np.errstate(all="ignore"):  # weights that are not finite are refused below
            codec = AutoencoderCodec(
                *(folded(_layers(content, part, path)) for part in ("encoder", "decoder"))
            )
    except (ValueError, KeyError, IndexError, TypeError) as error:
        raise FormatError(f"{path}: not an autoencoder of LangSplat's kind ({error})") from None
    if not all(np.isfinite(tensor).all() for tensor in codec.tensors().values()):
        raise FormatError(f"{path}: the autoencoder's weights are not finite; it was trained to nothing")
    return codec


def _layers(content: Mapping[str, Any], part: str, path: Path) -> list[Layer]:
    """Return the named weights of every layer that has any, in the network's order."""
    layers: dict[int, Layer] = {}
    for name, value in content.items():
        found = layer_name(name)
        array = plain_array(value, path) if found and found[1] == part else None
        if found and array is not None:
            layers.setdefault(int(found[2]), {})[found[3]] = array.astype(np.float64)
    return [layers[number] for number in sorted(layers)]


def autoencoder_weights(encoder: Layers, decoder: Layers) -> dict[str, Array]:
    """Return the dictionary of a codec; its batch normalisations are folded, so those written are neutral."""
    named: dict[str, Array] = {}
    for part, layers, step in (("encoder", encoder, 3), ("decoder", decoder, 2)):
        for number, (weight, bias) in enumerate(layers):
            named |= {f"{part}.{step * number}.weight": weight, f"{part}.{step * number}.bias": bias}
    for number, (_, bias) in enumerate(encoder[:-1]):
        ones, zeros = np.ones(len(bias), np.float32), np.zeros(len(bias), np.float32)
        neutral = {"weight": ones, "bias": zeros, "running_mean": zeros}
        neutral |= {
            "running_var": ones - np.float32(EPSILON),
            "num_batches_tracked": np.array(0, np.int64),
        }
        named |= {f"encoder.{3 * number + 1}.{name}": array for name, array in neutral.items()}
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
# It is wrapped as (tuple, iteration). The number of elements does not identify a method: two add two each.

GEOMETRY = 7  # number of elements in common


def model_tuple(content: Any) -> tuple[Any, ...] | None:
    """Return the elements of a Gaussian model in a file's content; None for other content."""
    if isinstance(content, (tuple, list)) and len(content) == 2 and isinstance(content[0], (tuple, list)):
        content = content[0]
    if not isinstance(content, (tuple, list)) or len(content) <= GEOMETRY:
        return None
    return tuple(content) if isinstance(content[0], int) else None


_ELEMENTS: Mapping[str, tuple[int | str, ...]] = {
    "positions": ("N", 3),
    "base colours": ("N", 1, 3),
    "SH coefficients": ("N", "K", 3),
    "log scales": ("N", 3),
    "rotations": ("N", 4),
    "opacities": ("N", 1),
}


def gaussians_of(elements: tuple[Any, ...], path: Path) -> Gaussians:
    """Return the Gaussians in elements 1 to 6; FormatError if one has another shape."""
    arrays, dims = [], dict[str, int]()
    for index, (name, shape) in enumerate(_ELEMENTS.items(), 1):
        array = plain_array(elements[index], path)
        if array is None or array.dtype.kind != "f":
            raise FormatError(f"{path}: element {index} holds no {name}; is it a checkpoint of Gaussians?")
        try:
            dims = check_array(name, array, shape, dims)
        except ValueError as error:
            raise FormatError(f"{path}: element {index}: {error}") from None
        arrays.append(np.asarray(array, np.float32))
    means, base, rest, log_scales, quats, logits = arrays
    if 3 * dims["K"] not in REST_COUNTS:
        raise FormatError(f"{path}: {dims['K']} SH coefficients beside the constant; expected 0, 3, 8, 15")
    return Gaussians(means, log_scales, quats, logits[:, 0], np.concatenate([base, rest], axis=1))


# Checkpoints that LangSplat reads: element 7 has the features, the optimiser's state is empty.


def write_checkpoint(path: Path, gaussians: Gaussians, features: Array, origin: Array = NO_ORIGIN) -> None:
    """Write a level's checkpoint with (N, D) float32 `features`, zero for a Gaussian without a feature.

    It loads with and without `weights_only`. An `origin` (3,) of the positions is written beside it.
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
    _save((elements, 30_000), path)
    beside = companion_path(path, ORIGIN_SUFFIX)
    if origin.any():
        write_origin(beside, origin)
    else:
        beside.unlink(missing_ok=True)


def write_autoencoder(path: Path, encoder: Layers, decoder: Layers) -> None:
    """Write `best_ckpt.pth` of a codec."""
    _save({name: _tensor(array) for name, array in autoencoder_weights(encoder, decoder).items()}, path)


def _tensor(array: Array) -> Any:
    import torch

    return torch.from_numpy(np.array(array, order="C"))  # a copy: torch saves the whole array of a view


def _save(content: Any, path: Path) -> None:
    import torch

    # Given a path, torch 2.8 does not report a full disk.
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        torch.save(content, file)


def export_langsplat(scene: Scene, folder: Path, progress: Progress = silent) -> tuple[str, ...]:
    """Write `NAME_{1,2,3}/chkpnt30000.pth` with latents and `best_ckpt.pth`; return the paths.

    Raises InputError for a scene whose codec is not an autoencoder of 3 numbers.
    """
    language, name = scene.language, scene.path.stem if scene.path else "scene"
    if language is None:
        raise InputError(f"{scene.path}: has no language field to write; 'langsplat train' makes one")
    codec = language.codec
    if not isinstance(codec, AutoencoderCodec) or codec.latent_dim != LATENT:
        raise InputError(
            f"{scene.path}: its codec, {codec.kind} of {codec.size}, is not "
            "LangSplat's autoencoder of 3 numbers; train with --codec.kind autoencoder"
        )
    latents = np.where(language.known[..., None], language.latents, np.float32(0))
    written = [folder / f"{name}_{level + 1}" / "chkpnt30000.pth" for level in range(len(LEVELS))]
    for level, path in enumerate(written):
        write_checkpoint(path, scene.gaussians, latents[level], scene.origin)
    write_autoencoder(folder / "best_ckpt.pth", codec.encoder, codec.decoder)
    return (*map(str, written), str(folder / "best_ckpt.pth"))


LOSES = ("cameras", "metres per unit", "antialiasing", "extra properties", "taught words", "origin")
EXPORTER = Exporter(export_langsplat, LOSES)
