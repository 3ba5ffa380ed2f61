"""From photographs to a searchable scene: the whole method, one line a stage.

Every stage keeps its result in the work folder under a key of its settings, so that an interrupted run
continues where it stopped and a changed setting recomputes only what depends on it.
"""

import json
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import LiftConfig, TrainConfig
from langsplat_core.datasets import load_capture
from langsplat_core.datasets.capture import Capture
from langsplat_core.errors import InputError
from langsplat_core.files import atomic_path
from langsplat_core.formats import read_ply, save_scene, write_ply
from langsplat_core.pipeline.stages import capture_digest, stage_key
from langsplat_core.progress import Progress, silent
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.scene import CANONICAL_PHRASES, Camera, Codec, Gaussians, LanguageField, Scene
from langsplat_core.semantics.clip import ClipEncoder, load_clip
from langsplat_core.semantics.masks import MaskSource, load_mask_source
from langsplat_core.semantics.store import FeatureStore, ImageFeatures, describe_capture
from langsplat_core.training.language.codec_fit import fit_codec, reconstruction_cosine
from langsplat_core.training.language.lift import find_memberships, lift_latents, lift_vectors
from langsplat_core.training.radiance.train import evaluate_views, train_radiance

log = logging.getLogger("langsplat")

Views = list[tuple[Camera, ImageFeatures]]
CODEC_SAMPLE = 20_000  # lifted vectors that the codec is fitted to beside the masks' own


@dataclass(frozen=True)
class TrainReport:
    """What a run did, as written to `report.json` in its work folder."""

    views: int
    held_out: int
    gaussians: int
    psnr: float | None  # mean over held-out views, dB; None without held-out views
    masks: str  # name of the mask source
    encoder: str
    mask_count: int
    codec_cosine: float  # mean cosine of mask vectors with their reconstruction
    observed: float  # fraction of Gaussians with a meaning at the whole level
    seconds: dict[str, float]  # per stage, of this run: a stage that was already done takes almost none


def train_scene(
    dataset: Path,
    out: Path,
    config: TrainConfig,
    work: Path | None = None,
    progress: Progress = silent,
    masks_of: Callable[[Capture], MaskSource] | None = None,
) -> TrainReport:
    """Train `out` (a .ply; sidecar and cameras beside it) from the photographs in `dataset`.

    `masks_of` makes another mask source than ``config.masks`` names, once the photographs are read.
    """
    if out.suffix.lower() != ".ply":
        raise InputError(f"{out}: the scene must be named *.ply, for example --out {out.with_suffix('.ply')}")
    work = work or out.with_name(out.stem + ".work")
    clock = _Clock()

    encoder = load_clip(
        config.clip.model, config.clip.device
    )  # first: absent weights should not cost an hour
    named = None if masks_of else load_mask_source(config.masks, config.clip.device)
    capture = load_capture(dataset, config.dataset, work, progress)
    mask_source = named or masks_of(capture)  # type: ignore[misc]  # one of them is there
    log.info("masks: %s, encoder: %s", mask_source.name, encoder.id)
    train, held_out = capture.split(config.dataset.test_every)
    clock.lap("photographs")

    gaussians = trained_gaussians(capture, train, config, work, progress)
    clock.lap("radiance")

    features = describe_capture(
        [capture.images[i] for i in train],
        [capture.cameras[i].name for i in train],
        mask_source,
        encoder,
        FeatureStore(work / "features"),  # keyed by mask settings, encoder and image
        progress,
    )
    views = [(capture.cameras[i], item) for i, item in zip(train, features, strict=True)]
    clock.lap("masks and vectors")

    language, codec_cosine = language_field(gaussians, views, encoder, config, progress)
    clock.lap("language field")

    save_scene(out, Scene(gaussians, language, tuple(capture.cameras[i] for i in train)))
    psnr = None
    if held_out:
        psnr = float(np.mean([view.psnr for view in evaluate_views(gaussians, capture, held_out)]))
    clock.lap("saving and held-out views")
    report = TrainReport(
        views=len(train),
        held_out=len(held_out),
        gaussians=len(gaussians),
        psnr=psnr,
        masks=mask_source.name,
        encoder=encoder.id,
        mask_count=sum(len(item.vectors) for item in features),
        codec_cosine=codec_cosine,
        observed=float((language.confidence[2] > 0).mean()) if len(gaussians) else 0.0,
        seconds=clock.laps,
    )
    with atomic_path(work / "report.json") as temporary:
        temporary.write_text(json.dumps(report.__dict__, indent=1))
    return report


def trained_gaussians(
    capture: Capture, train: list[int], config: TrainConfig, work: Path, progress: Progress
) -> Gaussians:
    """The Gaussians of the photographs at `train`, from `work` where they were trained before."""
    photographs = capture_digest(capture, train)
    # The backend changes who computes, not what: a run may move between machines.
    settings = replace(config.radiance, backend="auto")
    done = work / f"{stage_key('radiance', 1, settings, photographs)}.ply"
    if done.exists():
        return read_ply(done)
    gaussians = train_radiance(
        capture, config.radiance, train, done.with_suffix(".checkpoint.safetensors"), progress
    )
    write_ply(done, gaussians)
    done.with_suffix(".checkpoint.safetensors").unlink(missing_ok=True)
    return gaussians


def language_field(
    gaussians: Gaussians, views: Views, encoder: ClipEncoder, config: TrainConfig, progress: Progress
) -> tuple[LanguageField, float]:
    """The language field of the views' mask vectors, and the codec's mean cosine on these."""
    rasterizer = CpuRasterizer()
    mask_vectors = np.concatenate([features.vectors for _, features in views])
    if len(mask_vectors) == 0:
        raise InputError(
            "no masks were found in any photograph; try --masks.source graph, or larger photographs"
        )
    if config.lift.mode == "one-pass":
        codec = fit_codec(mask_vectors, config.codec, progress)
        latents, confidence = lift_latents(rasterizer, gaussians, views, codec, progress=progress)
    else:
        lifted = _lifted_vectors(gaussians, views, config.lift, progress)
        codec = fit_codec(_codec_data(mask_vectors, lifted, config.codec.seed), config.codec, progress)
        latents = np.stack([_encode(codec, vectors, weight) for vectors, weight in lifted])
        confidence = np.stack([weight for _, weight in lifted])
    field = LanguageField(
        latents=latents,
        confidence=confidence,
        codec=codec,
        canonical=encoder.encode_texts(list(CANONICAL_PHRASES)),
        encoder_id=encoder.id,
        phrasebook=_phrasebook(encoder, config.phrases),
    )
    return field, reconstruction_cosine(codec, mask_vectors)


def _phrasebook(encoder: ClipEncoder, phrases: tuple[str, ...]) -> dict[str, Array]:
    names = [" ".join(phrase.lower().split()) for phrase in phrases]
    return dict(zip(names, encoder.encode_texts(names), strict=True))


def _lifted_vectors(
    gaussians: Gaussians, views: Views, config: LiftConfig, progress: Progress
) -> list[tuple[Array, Array]]:
    """Per level: (N, D) float16 unit vectors and (N,) confidence. Half precision because three levels
    of 512 numbers for a million Gaussians are 3 GB even so; its error, 5e-4, is far below a mask's."""
    memberships = find_memberships(CpuRasterizer(), gaussians, views, config.chunk, progress=progress)
    levels = []
    for vectors, confidence in lift_vectors(memberships, robust=config.mode == "median"):
        levels.append((vectors.astype(np.float16), confidence))
        progress("averaging mask vectors", len(levels) / 3)
    return levels


def _codec_data(mask_vectors: Array, lifted: list[tuple[Array, Array]], seed: int) -> Array:
    """Mask vectors, and as many lifted ones again as `CODEC_SAMPLE` allows: those are what it encodes."""
    generator = np.random.default_rng(seed)
    samples = [mask_vectors]
    for vectors, confidence in lifted:
        seen = np.flatnonzero(confidence > 0)
        rows = generator.permutation(seen)[: CODEC_SAMPLE // len(lifted)]
        samples.append(vectors[rows].astype(np.float32))
    return np.concatenate(samples)


def _encode(codec: Codec, vectors: Array, confidence: Array, chunk: int = 65_536) -> Array:
    """(N, D) -> (N, d) latents, zero where unobserved."""
    latents = np.zeros((len(vectors), codec.latent_dim), np.float32)
    for start in range(0, len(vectors), chunk):
        part = slice(start, start + chunk)
        latents[part] = codec.encode(vectors[part].astype(np.float32))
    return np.where(confidence[:, None] > 0, latents, 0).astype(np.float32)


class _Clock:
    """Seconds per stage."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = round(now - self._last, 1)
        self._last = now
