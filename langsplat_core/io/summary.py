"""Summary of a scene in numbers: the health of its rows and where its bytes go."""

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.io.scenes import scene_files
from langsplat_core.scene import LEVELS, LanguageField, Scene


def summarise(scene: Scene) -> dict[str, Any]:
    """Return every figure of a scene of any size, an empty one included, ready for JSON."""
    gaussians = scene.gaussians
    valid = gaussians.valid()
    means = gaussians.means[valid] if valid.any() else np.zeros((1, 3))
    return {
        "gaussians": len(gaussians),
        "invalid": gaussians.invalid_rows(),  # reason -> rows, each under its first
        "invalid_rows": int((~valid).sum()),
        "bounds": scene.in_world(np.quantile(means, [0.01, 0.99], axis=0)).tolist(),  # in the world
        "origin": scene.origin.tolist(),  # what the means in memory are relative to, in the world
        "sh_degree": gaussians.sh_degree,
        "antialiased": scene.antialiased,
        "metres_per_unit": scene.metres_per_unit,
        "extras": list(scene.extras),
        "cameras": len(scene.cameras),
        "memory_bytes": memory_bytes(scene),
        "language": None if scene.language is None else _language(scene.language),
    }


def memory_bytes(scene: Scene) -> int:
    """Return the bytes in memory of the arrays that grow with the number of Gaussians."""
    arrays = [getattr(scene.gaussians, field.name) for field in fields(scene.gaussians)]
    own = sum(array.nbytes for array in (*arrays, *scene.extras.values()))
    return own + (0 if scene.language is None else _bytes(scene.language))


def disk_bytes(scene: Path) -> int:
    """Return the size of a scene file, or of a folder's files, with the companions beside it."""
    return sum(file.stat().st_size for file in scene_files(scene) if file.is_file())


def _bytes(field: LanguageField) -> int:
    leaves: tuple[Array, ...] = () if field.tree is None else (field.tree.leaves,)
    return sum(array.nbytes for array in (field.latents, field.confidence, *leaves))


def _language(field: LanguageField) -> dict[str, Any]:
    shares = (field.confidence > 0).mean(axis=1) if len(field) else np.zeros(len(LEVELS))
    nodes = None if field.tree is None else [int((field.tree.levels == n).sum()) for n in range(len(LEVELS))]
    return {
        "codec": field.codec.kind,
        "size": field.codec.size,  # codewords of a codebook, numbers per latent of other kinds
        "encoder": field.encoder_id,
        "vector_dim": field.codec.vector_dim,
        "phrases": len(field.phrasebook),
        "taught": [word.name for word in field.taught],
        "observed": dict(zip(LEVELS, shares.tolist(), strict=True)),  # share of the Gaussians with a meaning
        "nodes": nodes,  # of the tree, at each level; None: the scene keeps no tree
        "calibrated": field.calibration is not None,  # whether answers come with a probability
        "bytes": _bytes(field),  # latents, confidences and leaves of the tree
    }
