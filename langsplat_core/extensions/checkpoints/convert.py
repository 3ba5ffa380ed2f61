"""What `langsplat convert` reads and writes of other methods."""

from langsplat_core.errors import InputError
from langsplat_core.extensions.checkpoints.methods import read_foreign
from langsplat_core.io.exchange import Exporter, ExportRequest, Importer, ImportRequest
from langsplat_core.progress import Progress
from langsplat_core.scene import Scene


def _import(request: ImportRequest, progress: Progress) -> tuple[Scene, tuple[str, ...]]:
    """Return the scene of a method's files, and lines that say what came over."""
    from langsplat_core.extensions.checkpoints.importing import import_scene  # imports torch

    foreign = read_foreign(request.paths, request.levels)
    scene, report = import_scene(foreign, request.encoder, request.phrases, request.codec, progress)
    lines = [f"{report.method}: {'; '.join(report.notes)}"]
    if scene.language is not None:
        shares = ", ".join(f"{share:.0%}" for share in report.meaningful)
        lines.append(
            f"with language features at subpart, part, whole: {shares} of the Gaussians; "
            f"codec {report.codec} of {report.codec_size}, encoder {scene.language.encoder_id}"
        )
    if report.loss is not None:
        lines.append(
            f"relevancy error of the codec: mean {report.loss.error_mean:.4f}, "
            f"99 % below {report.loss.error_p99:.4f}; mean cosine {report.loss.cosine:.4f}"
        )
    return scene, tuple(lines)


def _export_langsplat(request: ExportRequest, progress: Progress) -> tuple[str, ...]:
    from langsplat_core.extensions.checkpoints.exporting import export_langsplat

    return tuple(map(str, export_langsplat(request.load(), request.out, request.sources[0].stem)))


def _export_occam(request: ExportRequest, progress: Progress) -> tuple[str, ...]:
    from langsplat_core.extensions.checkpoints.exporting import export_occam

    return tuple(map(str, export_occam(request.load(), request.out, progress)))


def _export_features(request: ExportRequest, progress: Progress) -> tuple[str, ...]:
    from langsplat_core.extensions.checkpoints.exporting import (
        features_from_langsplat,
        features_to_langsplat,
        langsplat_stems,
    )
    from langsplat_core.semantics.store import FeatureStore

    folder = request.sources[0]
    if len(request.sources) > 1 or not folder.is_dir():
        raise InputError(f"{folder}: --to features reads one folder of masks and vectors of photographs")
    if langsplat_stems(folder):
        count = features_from_langsplat(folder, FeatureStore(request.out), progress)
    else:
        count = features_to_langsplat(FeatureStore(folder), request.out, progress)
    return (f"{request.out}: masks and vectors of {count} photographs",)


IMPORTER = Importer((".pth", ".pt", ".ckpt", ".npz"), _import)
LANGSPLAT = Exporter("a folder with LangSplat's three checkpoints and its autoencoder", _export_langsplat)
OCCAM = Exporter("a folder with Occam's LGS's three checkpoints of whole vectors", _export_occam)
FEATURES = Exporter(
    "masks and vectors of photographs, `features` of a training's work folder, as LangSplat's "
    "language_features, or the other way",
    _export_features,
)
