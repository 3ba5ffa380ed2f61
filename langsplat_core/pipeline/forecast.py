"""Forecast of a training's duration: from measured costs beforehand, then from how fast this run is.

The costs are seconds of two CPU cores, measured on photographs and rooms (docs/photographs.md,
docs/encoders.md); what a GPU makes of them is a guess. They are rough; what a run has behind it corrects them
by one factor, its pace.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from langsplat_core.config import DatasetConfig, MaskConfig, RadianceBudget, TrainConfig
from langsplat_core.io.hostile import PHOTO_SUFFIXES, is_video
from langsplat_core.progress import ALL_STAGES, Progress, Report, coarse, duration

ASPECT = 0.75  # height by width of an ordinary photograph
SLOWEST, FASTEST = 20.0, 0.02  # limits of the pace: more is a sleeping machine, less a stage that was kept
SURE = 0.05  # share of a stage from which its own speed is trusted
GPU = 1 / 30  # of the seconds of two CPU cores; not measured
POINT = 0.17  # seconds of a point that a segmenter is asked at
REGIONS = 300  # of an ordinary photograph
DEPTHS = 0.3  # seconds of a photograph whose depths are found
REHEARSALS = 2  # of a budget: it ends with the first that does not gain
AGREEING = 1.7  # seconds of a megapixel that masks are drawn into, once they agree
# Millions of weights by what a hub id contains, the first that fits.
MILLIONS = {
    "vit-huge": 641,
    "vit-large": 312,
    "vit-base": 94,
    "hiera-large": 224,
    "hiera-base": 81,
    "hiera-small": 46,
    "hiera-tiny": 39,
    "vit-h": 986,
    "vit-l": 428,
    "so400m": 878,
    "large": 400,
}
USUAL = 150  # millions of weights of any other: CLIP's of ViT-B
Given = Literal["nothing", "cameras", "points"]  # what photographs come with: cameras, or cameras and points


@dataclass(frozen=True)
class Stage:
    """One of the steps from photographs to a scene."""

    name: str
    reported: tuple[str, ...]  # names that it reports under; none where it takes every other
    seconds: float  # that it is expected to take


def plan(
    config: TrainConfig, photographs: int, given: Given, has_gaussians: bool, on_gpu: bool = False
) -> tuple[Stage, ...]:
    """The stages of a training from so many photographs, in their order; on_gpu: whether models run there."""
    megapixels = ASPECT * config.dataset.max_side**2 / 1e6
    speed = GPU if on_gpu else 1.0
    masks = _mask_seconds(config.masks, megapixels, speed)
    vectors = _encoder_seconds(config.clip.model, config.masks) * speed
    agreeing = 0.0 if _has_segmenter(config.masks) else AGREEING * megapixels  # and then the vectors
    gaussians = config.radiance.max_gaussians
    depths = DEPTHS * photographs if photographs <= config.radiance.few_views else 0.0
    *smaller, whole = config.radiance.budgets(photographs, config.dataset.max_side)
    rehearsed = REHEARSALS * sum(map(_training_seconds, [*smaller, whole] if smaller else []))
    training = rehearsed + _training_seconds(whole)
    codec = config.codec.seconds
    lifting = photographs * (0.2 + 0.5 * megapixels) + 1e-4 * gaussians * min(photographs, 100) / 50
    if config.lift.mode == "gradient":
        lifting += 0.02 * config.lift.steps
    return (
        Stage(
            "photographs",
            (
                *("preparing photographs", "finding features", "matching photographs", "locating cameras"),
                *("triangulating points", "reading photographs"),
            ),
            photographs * {"nothing": 5.0, "cameras": 2.5, "points": 0.05}[given],
        ),
        Stage(
            "masks and vectors",
            ("masks and vectors",),
            photographs * (masks if agreeing else masks + vectors),
        ),
        Stage(
            "Gaussians",
            ("rehearsing", "finding depths", "training Gaussians"),
            0.0 if has_gaussians else training + depths,
        ),
        Stage(
            "language field",
            (),
            lifting + codec + photographs * (agreeing + vectors if agreeing else 0.0),
        ),
    )


def _training_seconds(budget: RadianceBudget) -> float:
    """A step costs what it draws, and what it keeps: 0.02 s at 0.1 megapixels, 0.1 s at 100 000 Gaussians."""
    megapixels = ASPECT * budget.longer_side**2 / 1e6
    return budget.steps * (0.2 * megapixels + 1e-6 * min(budget.max_gaussians, 300_000))


def _has_segmenter(masks: MaskConfig) -> bool:
    return bool(masks.sam) and masks.source != "graph"


def _mask_seconds(masks: MaskConfig, megapixels: float, speed: float) -> float:
    if not _has_segmenter(masks):
        return 0.4 + megapixels
    of_million = 0.14 if "sam2" in masks.sam.lower() else 0.24  # seconds of seeing an image
    crops = sum(4**layer for layer in range(masks.crop_layers + 1))
    seeing, asking = of_million * _millions(masks.sam), POINT * masks.points_per_side**2
    return megapixels + crops * (seeing + asking) * speed


def _encoder_seconds(model: str, masks: MaskConfig) -> float:
    if model == "demo":
        return 1.2
    regions = min(REGIONS, 2 * masks.points_per_side**2) if masks.sam else REGIONS
    return 0.45 * regions * (_millions(model) / USUAL) ** 1.4


def _millions(model: str) -> float:
    """Weights of a model, in millions: of its files, at four bytes each, or as its name says."""
    path = Path(model).expanduser()
    files = [path] if path.is_file() else [*path.glob("*.safetensors")] or [*path.glob("*.bin")]
    if files:
        return sum(file.stat().st_size for file in files) / 4e6
    return next((count for part, count in MILLIONS.items() if part in model.lower()), USUAL)


def count_photographs(dataset: Path) -> tuple[int, Given]:
    """Count the photographs in a dataset, and name what comes with them. Does not raise."""
    try:
        if is_video(dataset):
            return DatasetConfig.frames, "nothing"
        folder = dataset if dataset.is_dir() else dataset.parent
        images = folder / "images" if (folder / "images").is_dir() else folder
        return sum(path.suffix.lower() in PHOTO_SUFFIXES for path in images.iterdir()), _given(folder)
    except OSError:
        return 0, "nothing"


def _given(folder: Path) -> Given:
    # COLMAP's models have points as a rule; a transforms.json has cameras, and may name a file of points.
    frames = folder / "transforms.json"
    if frames.is_file():
        return "points" if b'"ply_file_path"' in frames.read_bytes() else "cameras"
    return "points" if (folder / "sparse").is_dir() else "nothing"


def forecast_in_words(stages: Sequence[Stage], on_gpu: bool = False) -> str:
    """Return the cost of a plan: "about 6 min on two CPU cores (photographs 80 s, ...)"."""
    where = "two CPU cores and a GPU" if on_gpu else "two CPU cores"
    parts = ", ".join(f"{stage.name} {duration(stage.seconds)}" for stage in stages if stage.seconds > 1)
    return f"about {duration(sum(stage.seconds for stage in stages))} on {where} ({parts})"


@dataclass(eq=False)
class Forecast:
    """Passes reports on and adds one of the whole: how far it is, and the seconds that are left of it."""

    stages: tuple[Stage, ...]
    inner: Progress
    clock: Callable[[], float] = time.monotonic
    _current: int = 0
    _began: list[float] = field(default_factory=list)  # when each stage began, seconds

    def show(self, report: Report) -> None:
        """Pass on a report of a stage; ``Progress(forecast.show)`` is what the work reports to."""
        self.inner.show(report)
        now, stage = self.clock(), self._stage_of(report.stage)
        if stage < self._current:
            return
        self._current = stage
        while len(self._began) <= stage:
            self._began.append(now)
        done, left = self._measure(now, report.fraction)
        self.inner(ALL_STAGES, done, seconds_left=coarse(left))

    def _stage_of(self, name: str) -> int:
        known = (number for number, stage in enumerate(self.stages) if name in stage.reported)
        return next(known, len(self.stages) - 1)

    def _measure(self, now: float, fraction: float) -> tuple[float, float]:
        """Share of the whole that is done, and seconds that are left."""
        pace = self._pace()
        stage = self.stages[self._current]
        expected, spent = stage.seconds * pace, now - self._began[self._current]
        if fraction > SURE and len(stage.reported) == 1:  # it is that of the stage
            expected = spent + (spent / fraction - spent + expected * (1 - fraction)) / 2
        current = max(expected - spent, 0.0)
        left = current + pace * sum(stage.seconds for stage in self.stages[self._current + 1 :])
        before = now - self._began[0]
        return (before / (before + left) if before + left > 0 else 1.0), left

    def _pace(self) -> float:
        """Ratio of the time that the stages behind took to the time expected."""
        expected = sum(stage.seconds for stage in self.stages[: self._current])
        if expected <= 0:
            return 1.0
        taken = self._began[self._current] - self._began[0]
        return min(max(taken / expected, FASTEST), SLOWEST)
