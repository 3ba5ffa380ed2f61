"""What a scene costs, and what it is worth: bytes, milliseconds, decibels."""

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from langsplat_core.arrays import psnr
from langsplat_core.compaction.contribution import MeasuringView, draw, measuring_views, psnr_losses
from langsplat_core.compaction.views import Views
from langsplat_core.errors import InputError
from langsplat_core.formats import load_scene, save_scene
from langsplat_core.formats.summary import disk_bytes, memory_bytes
from langsplat_core.raster.protocol import Rasterizer
from langsplat_core.scene import Scene

ROUNDS = 3  # timed pictures of every measuring view
UNLIKE = 10.0  # dB: a scene that is this far from the photographs does not show what they show


@dataclass(frozen=True)
class Weight:
    """What a scene costs, and what it is worth."""

    gaussians: int
    sh_degree: int
    disk_bytes: int  # in the target format, with language field and cameras
    memory_bytes: int  # arrays of the Gaussians, extra properties and language field
    render_ms: float  # mean over the measuring views, CPU backend; before and after drawn in turn
    psnr: float | None  # mean against the photographs, dB; None without


@dataclass(frozen=True, eq=False)
class Stored:
    """A scene as the target format gives it back, and the size of its files."""

    scene: Scene
    disk_bytes: int


def check_likeness(measured: Sequence[MeasuringView]) -> None:
    scores = [psnr(e.original, e.photograph) for e in measured if e.photograph is not None]
    if scores and np.mean(scores) < UNLIKE:
        raise InputError(
            f"the photographs show something else than the scene (PSNR {np.mean(scores):.1f} dB); "
            "give the dataset that it was trained on, or leave --photos out"
        )


def stored(scene: Scene, out: Path) -> Stored:
    """The scene after a journey through a file named like `out`."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / out.name
        save_scene(path, replace(scene, path=path))
        return Stored(load_scene(path), disk_bytes(path))


def weigh(
    rasterizer: Rasterizer, pair: tuple[Stored, Stored], measured: Sequence[MeasuringView]
) -> list[Weight]:
    times = _render_times(rasterizer, (pair[0].scene, pair[1].scene), measured)
    return [
        Weight(
            gaussians=len(stored.scene.gaussians),
            sh_degree=stored.scene.gaussians.sh_degree,
            disk_bytes=stored.disk_bytes,
            memory_bytes=memory_bytes(stored.scene),
            render_ms=milliseconds,
            psnr=mean_psnr(rasterizer, stored.scene, measured),
        )
        for stored, milliseconds in zip(pair, times, strict=True)
    ]


def worst_loss(
    rasterizer: Rasterizer, before: Scene, after: Scene, views: Views, psnr_before: float
) -> float:
    """dB lost in the ranking view that loses most; one at a time, for their pictures may be many."""
    return max(
        float(
            psnr_losses(
                rasterizer, after, measuring_views(rasterizer, before, [camera], [None]), psnr_before
            )[0]
        )
        for camera in views.ranking
    )


def likeness(rasterizer: Rasterizer, scene: Scene, measured: Sequence[MeasuringView]) -> float:
    pictures = [np.clip(draw(rasterizer, scene, view.camera)[1], 0, 1) for view in measured]
    return float(np.mean([psnr(new, e.original) for new, e in zip(pictures, measured, strict=True)]))


def mean_psnr(rasterizer: Rasterizer, scene: Scene, measured: Sequence[MeasuringView]) -> float | None:
    scores = [
        psnr(np.clip(draw(rasterizer, scene, e.camera)[1], 0, 1), e.photograph)
        for e in measured
        if e.photograph is not None
    ]
    return float(np.mean(scores)) if scores else None


def _render_times(
    rasterizer: Rasterizer, scenes: tuple[Scene, Scene], measured: Sequence[MeasuringView]
) -> tuple[float, float]:
    """Milliseconds of a picture of each scene (projection, colours and blending): the best of `ROUNDS` per
    view, averaged over views. Drawn in turn, so that another program's load falls on both."""
    seconds = np.full((len(measured), 2), np.inf)
    for _ in range(ROUNDS):
        for best, view in zip(seconds, measured, strict=True):
            for which, scene in enumerate(scenes):
                start = time.perf_counter()
                draw(rasterizer, scene, view.camera)
                best[which] = min(best[which], time.perf_counter() - start)
    before, after = 1e3 * seconds.mean(0)
    return float(before), float(after)
