"""Few photographs: what depths, free space, exposures and masks of what moves gain, held out."""

import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from langsplat_core.arrays import Array, psnr
from langsplat_core.config import (
    QUICK,
    DatasetConfig,
    RadianceConfig,
    Seed,
    TrainConfig,
    TrainPreset,
    with_preset,
)
from langsplat_core.datasets import Capture, load_capture
from langsplat_core.datasets.capture import split_views
from langsplat_core.extensions.benchmarks.report import markdown
from langsplat_core.progress import Progress, TerminalProgress
from langsplat_core.raster.render import render
from langsplat_core.scene import Camera, Scene
from langsplat_core.training.radiance.differentiable import evaluate_views
from langsplat_core.training.radiance.rehearsal import (
    budget_text,
    budgets_for,
    rehearse,
    supported,
    train_within,
)
from tests.benchmarks.captures import Kind, draw_capture

LARGE = 800  # px, of a window beside them: with dilation as at the photographs' size, and growing
HEAD = (
    "capture", "training / held out", "preset", "with", "seed", "held out, dB", "exposure fitted, dB",
    f"at {QUICK.longer_side} px, dB", f"at {LARGE} px: dilation constant, growing", "SSIM", "training, dB",
    "budget", "rehearsed, dB", "Gaussians", "CPU-s",
)  # fmt: skip
# What a training has, beside its preset.
VARIANTS: dict[str, dict[str, object]] = {
    "before": {"few_views": 0, "rehearsed_views": 0, "exposure": "off", "transients": "off"},
    "depths": {"rehearsed_views": 0, "exposure": "off", "transients": "off"},
    "depths, exposures": {"rehearsed_views": 0, "transients": "off"},
    "all": {},
}


@dataclass(frozen=True)
class Few:
    """Held-out PSNR of captures: without what few photographs get, with depths, with exposures too, and
    without what moves and steps that do not pay."""

    folders: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Captures, as of `langsplat train`."""
    rooms: tuple[Seed, ...] = ()
    """Seeds of drawn captures, beside the folders."""
    kind: Kind = "few"
    """Of drawn captures: on an arc around a table, or straight ahead along a street."""
    people: bool = False
    """Into the training photographs of drawn captures go people, each time elsewhere."""
    presets: tuple[TrainPreset, ...] = ("quick",)
    variants: tuple[str, ...] = tuple(VARIANTS)
    views: int = 0
    """Photographs, evenly spread over the capture; 0: all."""
    test_every: int = 4
    uneven: float = 0.0
    """Deviation of the logarithm of the exposure that each training photograph is given; of that of each
    channel's gain, a third."""
    seeds: tuple[int, ...] = (0,)
    work: Path | None = None
    """Folder where drawn captures and cameras are kept from run to run."""

    def run(self) -> None:
        rows: list[tuple[str, ...]] = []
        with tempfile.TemporaryDirectory() as scratch, TerminalProgress() as progress:
            work = self.work or Path(scratch)
            drawn = [
                work / f"{self.kind}-{seed}{'-people' if self.people else ''}" / "photographs"
                for seed in self.rooms
            ]
            for seed, folder in zip(self.rooms, drawn, strict=True):
                draw_capture(folder, self.kind, seed, self.people, self.test_every, progress)
            for folder in (*self.folders, *drawn):
                name = folder.parent.name if folder in drawn else folder.name
                rows += self._rows(folder, name, work / name, progress)
        print(markdown(HEAD, rows))

    def _rows(self, folder: Path, name: str, work: Path, progress: Progress) -> Iterator[tuple[str, ...]]:
        large = self._capture(folder, work, LARGE, progress)[0]
        for preset in self.presets:
            config = with_preset(TrainConfig(), preset)
            capture, train, held_out = self._capture(folder, work, config.dataset.max_side, progress)
            for variant in self.variants:
                for seed in self.seeds:
                    settings = replace(config.radiance, seed=seed, **VARIANTS[variant])  # type: ignore[arg-type]
                    found = _measured(capture, large, settings, train, held_out, progress)
                    counts = f"{len(train)} / {len(held_out)}"
                    yield (name, counts, preset, variant, str(seed), *found)

    def _capture(
        self, folder: Path, work: Path, side: int, progress: Progress
    ) -> tuple[Capture, list[int], list[int]]:
        """The capture and its training and held-out views."""
        config = DatasetConfig(max_side=side, test_every=self.test_every, allow_few_cameras=True)
        capture = load_capture(folder, config, work, progress)
        if self.views:
            rows = np.unique(np.linspace(0, len(capture) - 1, self.views).round().astype(int))
            capture = _subset(capture, [int(row) for row in rows])
        train, held_out = split_views(capture, config)
        if not held_out:
            held_out = [len(capture) // 2]
            train = [row for row in train if row not in held_out]
        if self.uneven:
            rng = np.random.default_rng(0)
            gains = np.exp(rng.normal(0, self.uneven, (len(capture), 1)))
            gains = gains * np.exp(rng.normal(0, self.uneven / 3, (len(capture), 3)))
            gains[held_out] = 1.0
            images = [
                (image * gain).clip(0, 255).astype(np.uint8)
                for image, gain in zip(capture.images, gains, strict=True)
            ]
            capture = replace(capture, images=tuple(images), photos=())  # not as the files are
        return capture, train, held_out


def _subset(capture: Capture, rows: Sequence[int]) -> Capture:
    kept = {
        name: tuple(getattr(capture, name)[row] for row in rows) if getattr(capture, name) else ()
        for name in ("cameras", "images", "photos", "masks")
    }
    return replace(capture, **kept)  # type: ignore[arg-type]


def _measured(
    capture: Capture,
    large: Capture,
    config: RadianceConfig,
    train: Sequence[int],
    held_out: Sequence[int],
    progress: Progress,
) -> tuple[str, ...]:
    began = time.process_time()
    budgets = budgets_for(capture, config, len(train))
    found = rehearse(capture, config, budgets, train, progress=progress)
    budget = supported(found, budgets)
    gaussians = train_within(capture, budget, config, train, progress=progress)
    seconds = time.process_time() - began
    small = capture.read_at(held_out, QUICK.longer_side)
    scores = evaluate_views(gaussians, capture, held_out, small=small)
    learnt = evaluate_views(gaussians, capture, train)
    scene = Scene(gaussians, cameras=tuple(capture.cameras[i] for i in train))
    exposed = [score.psnr_exposed for score in scores if score.psnr_exposed is not None]
    means = [
        np.mean([score.psnr for score in scores]),
        np.mean(exposed) if exposed else np.nan,
        np.mean([score.psnr_small for score in scores if score.psnr_small is not None]),
    ]
    larger = [
        np.mean([psnr(_image(drawn, large.cameras[i]) / 255, large.images[i] / 255) for i in held_out])
        for drawn in (Scene(gaussians), scene)
    ]
    ssim = np.mean([score.ssim for score in scores])
    return (
        *(f"{mean:.2f}" for mean in means),
        ", ".join(f"{mean:.2f}" for mean in larger),
        *(f"{ssim:.3f}", f"{np.mean([score.psnr for score in learnt]):.2f}"),
        *(
            budget_text(budget),
            "; ".join(", ".join(f"{decibels:.2f}" for decibels in each) for each in found),
        ),
        *(str(len(gaussians)), f"{seconds:.0f}"),
    )


def _image(scene: Scene, camera: Camera) -> Array:
    return (255 * render(scene, camera).colours.clip(0, 1)).round().astype(np.uint8)
