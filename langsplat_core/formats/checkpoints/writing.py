"""Checkpoints as LangSplat and Occam's LGS read them: (tuple of a Gaussian model, iteration), see
`gaussian_tuple`; element 7 holds the features, and what an optimiser would need is empty."""

from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.arrays import Array, check_array
from langsplat_core.files import atomic_path
from langsplat_core.formats.checkpoints.autoencoder_weights import autoencoder_weights
from langsplat_core.scene import AutoencoderCodec, Gaussians

ITERATION = 30_000


def write_checkpoint(path: Path, gaussians: Gaussians, features: Array) -> None:
    """A level's checkpoint with (N, D) float32 `features`, zero where a Gaussian has no meaning; atomically.
    It loads with and without `weights_only`."""
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
        torch.zeros(count),  # largest radii in pictures
        nothing,  # sums of gradients
        nothing.clone(),  # and how many
        {"state": {}, "param_groups": []},
        1.0,  # the scene's extent, which scales a learning rate
    )
    _save((elements, ITERATION), path)


def write_autoencoder(path: Path, codec: AutoencoderCodec) -> None:
    """`best_ckpt.pth` of a codec, atomically."""
    _save({name: _tensor(array) for name, array in autoencoder_weights(codec).items()}, path)


def _tensor(array: Array) -> Any:
    import torch

    return torch.from_numpy(np.array(array, order="C"))  # its own copy: a view would save the whole of it


def _save(content: Any, path: Path) -> None:
    import torch

    with atomic_path(path) as temporary:
        torch.save(content, temporary)
