"""Gaussians that are still being trained: the checkpoints of `langsplat train` as scenes to look at.

A checkpoint has the raw parameters as tensors ``values.*``, colours in two parts; it is read without torch.
"""

from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open

from langsplat_core.errors import InputError
from langsplat_core.files import atomic_path
from langsplat_core.formats import write_ply
from langsplat_core.pipeline.report import work_folder
from langsplat_core.scene import Gaussians
from langsplat_viewer.files.watching import Stamps, stamps

PARTS = ("means", "log_scales", "quats_wxyz", "opacity_logits", "sh_dc", "sh_rest")
IN_TRAINING = ".checkpoint.safetensors"
NAME = "so-far.ply"  # in the work folder of a training


def newest(out: Path) -> Stamps:
    """The Gaussians of the training of `out` that were written last, in training or done, and their stamp;
    empty where there are none."""
    folder = work_folder(out)
    found = stamps((*folder.glob(f"radiance-*{IN_TRAINING}"), *folder.glob("radiance-*.ply")))
    return tuple(sorted(found, key=lambda file: file[1] or (0, 0))[-1:])


def write_preview(checkpoint: Path) -> Path:
    """Write the Gaussians of a checkpoint as a scene beside it. InputError where it cannot be read."""
    try:
        with safe_open(checkpoint, framework="numpy") as file:
            held = {name: file.get_tensor(f"values.{name}") for name in PARTS}
        sh = np.concatenate([held.pop("sh_dc"), held.pop("sh_rest")], 1)
        gaussians = Gaussians(**held, sh=sh)
    except (SafetensorError, OSError, ValueError, KeyError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{checkpoint}: no Gaussians in training ({reason})") from None
    path = checkpoint.with_name(NAME)
    with atomic_path(path) as temporary:
        write_ply(temporary, gaussians)
    return path
