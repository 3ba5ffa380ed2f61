"""A scene made as small as an error budget allows: fewer Gaussians, a lower SH degree, no training.

Gaussians are ranked by their contribution to one group of views (`contribution`). A second group,
which had no say in that order, measures what the pictures lose. For every SH degree that the budget allows
by itself, from the scene's own downward, the smallest number of Gaussians within the budget is found by
bisection; the degree with the fewest numbers wins. The contribution of the last Gaussian kept becomes a
threshold, and only now the second group has a say too: whatever contributes more than that to any of its
views is kept after all. Everything is measured as the target format stores it, and the file's own content is
read back and measured before it takes its name.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from langsplat_core.compaction.contribution import measuring_views, psnr_losses, reduced
from langsplat_core.compaction.language_change import LanguageChange, language_change
from langsplat_core.compaction.selection import select
from langsplat_core.compaction.views import Views, choose_views
from langsplat_core.compaction.weighing import (
    Weight,
    check_likeness,
    likeness,
    mean_psnr,
    stored,
    weigh,
    worst_loss,
)
from langsplat_core.config import CompactConfig
from langsplat_core.errors import InputError
from langsplat_core.formats import check_writable, load_scene, save_scene
from langsplat_core.formats.summary import disk_bytes
from langsplat_core.progress import Progress, silent
from langsplat_core.ranges import check_settings
from langsplat_core.raster import load_lifting_rasterizer
from langsplat_core.raster.protocol import Rasterizer
from langsplat_core.scene import Scene
from langsplat_core.scene.phrases import phrase_key
from langsplat_core.semantics.encoders import load_text_encoder

PHRASES = 8  # at most, of the phrasebook, asked before and after


@dataclass(frozen=True)
class CompactReport:
    """A compact scene beside its original; losses are over the measuring views, dB."""

    before: Weight
    after: Weight
    source_bytes: int  # the scene as given, in its own format
    budget: float
    unseen_loss: float  # mean, of what the ranking views alone chose: a guess for any other view
    loss: float  # mean, of the file
    worst_loss: float  # of any one view, ranking ones included, of the file
    assumed_psnr: float | None  # None: measured against photographs
    likeness: float  # PSNR of the compact pictures against the original ones, mean, at most 100
    threshold: float  # no dropped Gaussian contributes more to any view, display values times pixels
    ranking_views: int
    measuring_views: int
    views_from: str
    language: LanguageChange | None


def compact_scene(
    source: Path, out: Path, config: CompactConfig, photos: Path | None = None, progress: Progress = silent
) -> CompactReport:
    """Write the scene `source` to `out` as small as ``config.max_psnr_loss`` allows.

    `photos` is the dataset it was trained on; without, the loss is derived from the change of the pictures.
    Raises InputError, and leaves `out` as it was, where the budget cannot be kept or nothing can be dropped.
    """
    _check(source, out, config)
    scene = load_scene(source)
    rasterizer = load_lifting_rasterizer("cpu")
    views = choose_views(scene, photos, config, progress)
    measured = measuring_views(rasterizer, scene, views.measuring, views.photographs)
    check_likeness(measured)
    before = stored(scene, out)
    selection = select(rasterizer, before.scene, views, measured, config, progress)
    candidate = reduced(before.scene, selection.keep, selection.sh_degree)
    after = stored(candidate, out)
    losses = psnr_losses(rasterizer, after.scene, measured, config.assumed_psnr)
    if not losses.mean() <= config.max_psnr_loss:
        raise InputError(f"{out}: as stored it would lose {losses.mean():.3f} dB; not written, allow more")
    truth = mean_psnr(rasterizer, scene, measured) or config.assumed_psnr
    weighed = weigh(rasterizer, (replace(before, scene=scene), after), measured)
    report = CompactReport(
        before=weighed[0],
        after=weighed[1],
        source_bytes=disk_bytes(source),
        budget=config.max_psnr_loss,
        unseen_loss=selection.unseen_loss,
        loss=float(losses.mean()),
        worst_loss=max(float(losses.max()), worst_loss(rasterizer, scene, after.scene, views, truth)),
        assumed_psnr=config.assumed_psnr if photos is None else None,
        likeness=likeness(rasterizer, after.scene, measured),
        threshold=selection.threshold,
        ranking_views=len(views.ranking),
        measuring_views=len(views.measuring),
        views_from=views.origin,
        language=_language(rasterizer, (scene, after.scene), views, config.phrases),
    )
    save_scene(out, replace(candidate, path=out))
    return report


def _check(source: Path, out: Path, config: CompactConfig) -> None:
    check_writable(out)
    check_settings(config)
    if out.resolve() == source.resolve():
        raise InputError(f"{out}: would replace the original scene; choose another --out")


def _language(
    rasterizer: Rasterizer, scenes: tuple[Scene, Scene], views: Views, more: Sequence[str]
) -> LanguageChange | None:
    field = scenes[0].language
    if field is None:
        return None
    stored = list(field.phrasebook)[:PHRASES]
    phrases = list(dict.fromkeys([*map(phrase_key, more), *stored]))
    return language_change(rasterizer, scenes, views.measuring, phrases, load_text_encoder)
