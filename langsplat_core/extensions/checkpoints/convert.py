"""Files of other methods for `langsplat convert`."""

from pathlib import Path

import numpy as np

from langsplat_core.errors import InputError
from langsplat_core.extensions.checkpoints.langsplat_files import write_autoencoder, write_checkpoint
from langsplat_core.io.scenes import Exporter, Importer, ImportRequest
from langsplat_core.progress import Progress, silent
from langsplat_core.scene import LEVELS, AutoencoderCodec, Scene
from langsplat_core.scene.codec import SHORTEST

LANGSPLAT_LATENT = 3  # numbers per Gaussian that its rasterizer is compiled for


def _import(request: ImportRequest, progress: Progress) -> tuple[Scene, tuple[str, ...]]:
    """Return the scene in a method's files, and lines that report what was imported."""
    from langsplat_core.extensions.checkpoints.importing import import_scene, read_foreign  # imports torch

    foreign = read_foreign(request.paths, request.levels)
    if not foreign.told and (request.encoder is not None or request.phrases or request.levels):
        what = "--encoder, --levels and --phrases are of features, and it has none; leave them out"
        raise InputError(f"{request.paths[0]}: {what}")
    scene, loss = import_scene(foreign, request.encoder, request.phrases, request.codec, progress)
    lines = [f"{foreign.method}: {'; '.join(foreign.notes)}"]
    field = scene.language
    if field is not None:
        shares = ", ".join(f"{share:.0%}" for share in field.confidence.mean(1))
        lines.append(
            f"with language features at subpart, part, whole: {shares} of the Gaussians; "
            f"codec {field.codec.kind} of {field.codec.size}, encoder {field.encoder_id}"
        )
    if foreign.codec is not None:
        every = np.arange(len(scene.gaussians))
        latents = np.concatenate([foreign.rows(level, every) for level in foreign.told])
        lengths = np.linalg.norm(latents, axis=1)
        lengths = lengths[lengths > SHORTEST]
        if (np.abs(lengths - 1) > 0.01).any():
            low, high = lengths.min(), lengths.max()
            lines.append(
                f"latents {low:.3g} to {high:.3g} long, brought to length 1 as LangSplat does to draw"
            )
    if loss is not None:
        lines.append(
            f"relevancy error of the codec: mean {loss.error_mean:.4f}, "
            f"99 % below {loss.error_p99:.4f}; mean cosine {loss.cosine:.4f}"
        )
    return scene, tuple(lines)


def export_langsplat(scene: Scene, folder: Path, progress: Progress = silent) -> tuple[str, ...]:
    """Write `NAME_{1,2,3}/chkpnt30000.pth` with latents and `best_ckpt.pth`; return the paths.

    Raises InputError for a scene whose codec is not an autoencoder of 3 numbers.
    """
    language, name = scene.language, scene.path.stem if scene.path else "scene"
    if language is None:
        raise InputError(f"{scene.path}: has no language field to write; 'langsplat train' makes one")
    codec = language.codec
    if not isinstance(codec, AutoencoderCodec) or codec.latent_dim != LANGSPLAT_LATENT:
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


IMPORTER = Importer((".pth", ".pt", ".ckpt", ".npz"), _import)
LOSES = ("cameras", "metres per unit", "antialiasing", "extra properties", "taught words", "origin")
LANGSPLAT = Exporter(export_langsplat, LOSES)
