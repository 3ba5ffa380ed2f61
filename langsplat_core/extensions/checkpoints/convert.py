"""What `langsplat convert` reads and writes of other methods."""

import numpy as np

from langsplat_core.errors import InputError
from langsplat_core.extensions.checkpoints.langsplat_files import write_autoencoder, write_checkpoint
from langsplat_core.io.scenes import Exporter, ExportRequest, Importer, ImportRequest
from langsplat_core.progress import Progress, silent
from langsplat_core.scene import LEVELS, AutoencoderCodec, LanguageField, Scene
from langsplat_core.scene.codec import SHORTEST

LANGSPLAT_LATENT = 3  # numbers per Gaussian that its rasterizer is compiled for
BLOCK = 16_384  # Gaussians decoded at a time


def _import(request: ImportRequest, progress: Progress) -> tuple[Scene, tuple[str, ...]]:
    """Return the scene of a method's files, and lines that say what came over."""
    from langsplat_core.extensions.checkpoints.importing import import_scene, read_foreign  # imports torch

    foreign = read_foreign(request.paths, request.levels)
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
        every, told = np.arange(len(scene.gaussians)), [i for i in range(3) if foreign.levels[i] is not None]
        lengths = np.linalg.norm(np.concatenate([foreign.rows(level, every) for level in told]), axis=1)
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


def export_langsplat(request: ExportRequest, progress: Progress = silent) -> tuple[str, ...]:
    """Write `NAME_{1,2,3}/chkpnt30000.pth` with latents and `best_ckpt.pth`; return what was written.

    Raises InputError for a scene whose codec is not an autoencoder of 3 numbers.
    """
    scene, folder, name = request.load(), request.out, request.sources[0].stem
    language = _language(scene)
    codec = language.codec
    if not isinstance(codec, AutoencoderCodec) or codec.latent_dim != LANGSPLAT_LATENT:
        raise InputError(
            f"{scene.path}: its codec, {codec.kind} of {codec.size}, is not "
            "LangSplat's autoencoder of 3 numbers; write vectors by --to occam, or train with "
            "--codec.kind autoencoder"
        )
    latents = np.where(language.known[..., None], language.latents, np.float32(0))
    written = [folder / f"{name}_{level + 1}" / "chkpnt30000.pth" for level in range(len(LEVELS))]
    for level, path in enumerate(written):
        write_checkpoint(path, scene.gaussians, latents[level], scene.origin)
    write_autoencoder(folder / "best_ckpt.pth", codec.encoder, codec.decoder)
    return (*map(str, written), str(folder / "best_ckpt.pth"))


def export_occam(request: ExportRequest, progress: Progress = silent) -> tuple[str, ...]:
    """Write `chkpnt30000_langfeat_{1,2,3}.pth` with (N, D) unit vectors, zero for no meaning.

    Return what was written. One level is held in memory at a time: 5 GB for 2.5 million Gaussians.
    """
    scene = request.load()
    language = _language(scene)
    written = []
    for level in range(len(LEVELS)):
        path = request.out / f"chkpnt30000_langfeat_{level + 1}.pth"
        progress("decoding", level / len(LEVELS))
        vectors = np.zeros((len(language), language.codec.vector_dim), np.float32)
        known = np.flatnonzero(language.known[level])
        for start in range(0, len(known), BLOCK):
            rows = known[start : start + BLOCK]
            vectors[rows] = language.codec.decode(language.latents[level, rows])
        write_checkpoint(path, scene.gaussians, vectors, scene.origin)
        written.append(str(path))
    progress("decoding", 1.0)
    return tuple(written)


def _language(scene: Scene) -> LanguageField:
    if scene.language is None:
        raise InputError(f"{scene.path}: has no language field to write; 'langsplat train' makes one")
    return scene.language


IMPORTER = Importer((".pth", ".pt", ".ckpt", ".npz"), _import)
LOSES = ("cameras", "metres per unit", "antialiasing", "extra properties", "taught words", "origin")
LANGSPLAT, OCCAM = Exporter(export_langsplat, LOSES), Exporter(export_occam, LOSES)
