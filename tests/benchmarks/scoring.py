"""A scene against the ground truth of the procedural room it was photographed in.

Scores follow LERF and LangSplat: localisation (is the peak of the mean-filtered relevancy map on the
thing?) and segmentation (intersection over union), per view and phrase, averaged per kind of phrase; the same
overlap directly among the Gaussians; and rejection: how many absent objects are answered with "not here".
"""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from typing import Any, Literal, TypeVar

import numpy as np
from scipy.ndimage import uniform_filter

from assets.making.dataset import MIN_PIXELS, PHRASE_KINDS, Phrase, Truth
from langsplat_core.arrays import Array
from langsplat_core.config import LevelChoice, PictureConfig
from langsplat_core.extensions.benchmarks.report import intersection_over_union
from langsplat_core.progress import Progress, silent
from langsplat_core.query.answers import SPAN, QueryResult, Regions
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.lookup import decoded_relevancy, peak_pixel, splatted_relevancy
from langsplat_core.raster.protocol import Rasterizer, View
from langsplat_core.scene import Camera
from langsplat_core.semantics.relevancy import FLOOR
from langsplat_core.training.language.codec_fit import CodecReport

Row = TypeVar("Row")
MIN_GAUSSIANS = 20  # a thing with fewer is not asked for among the Gaussians
# px: the paper's mean filter for localisation, and its code's majority vote over a mask, both of images of
# 731 rows; smaller images get smaller windows, or a part would be lost in one
FILTER, VOTE, PAPER_ROWS = 20, 7, 731
CHANNELS = 32  # phrases that are splatted at a time
TOGETHER = 64  # phrases that are asked at a time
TIMED = 15  # phrases that are asked alone
HALF = 0.5  # of what a pixel shows: from there it belongs to an answer's Gaussians


@dataclass(frozen=True, eq=False)
class Asked:
    """Answers to all phrases, each asked once."""

    engine: QueryEngine
    answers: Mapping[str, QueryResult]
    unknown: tuple[str, ...]  # phrases with words that the encoder was never taught: not asked
    seconds: float  # median of one query from text to place; 0 where nothing was asked


@dataclass(frozen=True)
class Score:
    """One kind of phrase, in views."""

    kind: str
    queries: int  # (view, phrase) pairs
    mean_iou: float
    localisation: float  # share of pairs whose peak lies on the thing


@dataclass(frozen=True)
class DirectScore:
    """One kind of phrase, among the Gaussians themselves."""

    kind: str
    phrases: int
    mean_iou: float
    ceiling: float = 0.0  # mean IoU of the regions that are right, at the level where they fit best


def ask(engine: QueryEngine, texts: Iterable[str], level: LevelChoice = "auto") -> Asked:
    """Ask every phrase once, at a level, and some of them alone, for the time that one takes."""
    texts = list(dict.fromkeys(texts))
    unknown = [text for text in texts if engine.unknown_words(text)]
    known = [text for text in texts if text not in unknown]
    answers: dict[str, QueryResult] = {}
    for start in range(0, len(known), TOGETHER):
        some = known[start : start + TOGETHER]
        answers |= zip(some, engine.run_many(some, level), strict=True)
    # The engine has answered before, so that no time goes into preparation.
    seconds = [seconds_of(partial(engine.run, text, level)) for text in known[:TIMED]]
    return Asked(engine, answers, tuple(unknown), float(np.median(seconds)) if seconds else 0.0)


def seconds_of(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def evaluate(
    asked: Asked,
    rasterizer: Rasterizer,
    cameras: Sequence[Camera],
    truth: Truth,
    paper_order: bool = False,
    progress: Progress = silent,
) -> list[Score]:
    """Score every phrase that was asked, in every view where its thing is visible.

    paper_order: latents are blended and pixels decoded, instead of blending relevancies.
    """
    scene = asked.engine.scene
    masks_of = partial(_paper_masks, asked.engine) if paper_order else masks_and_peaks
    results: dict[str, list[tuple[float, bool]]] = {}
    for done, camera in enumerate(cameras):
        labels = truth.labels(camera.name)
        view = rasterizer.view(scene.gaussians, camera, scene.raster_settings())
        masks = {p: _mask(labels, p) for p in truth.phrases if p.text in asked.answers}
        visible = [phrase for phrase, mask in masks.items() if mask.sum() >= MIN_PIXELS]
        answers = [asked.answers[phrase.text] for phrase in visible]
        for phrase, (found, peak) in zip(visible, masks_of(view, answers), strict=True):
            score = intersection_over_union(found, masks[phrase]), bool(masks[phrase][peak])
            results.setdefault(phrase.kind, []).append(score)
        progress("asking phrases", (done + 1) / len(cameras))
    return [Score(*row) for row in _means(results)]


def _means(results: Mapping[str, Sequence[tuple[float, float]]]) -> Iterator[tuple[str, int, float, float]]:
    """Every kind of phrase that there is, with its number of results and the mean of each of both figures."""
    for kind in sorted(results, key=PHRASE_KINDS.index):
        one, other = np.mean(results[kind], axis=0).tolist()
        yield kind, len(results[kind]), one, other


def _mask(labels: Array, phrase: Phrase) -> Array:
    return np.asarray(np.isin(labels, phrase.ids).any(axis=0))


def masks_and_peaks(view: View, answers: Sequence[QueryResult]) -> Iterator[tuple[Array, tuple[int, int]]]:
    """Yield the mask (H, W) of each answer in a view, and the row and column of its peak.

    The mask is where members are more than half of what a pixel shows.
    """
    for start in range(0, len(answers), CHANNELS // 2):
        some = answers[start : start + CHANNELS // 2]
        columns = np.stack([*(one.even for one in some), *(one.members for one in some)], 1)
        maps = np.moveaxis(splatted_relevancy(view, columns, PictureConfig().alpha_gate), 2, 0)
        for relevancy, share in zip(maps[: len(some)], maps[len(some) :], strict=True):
            yield _smoothed_mask(share > HALF), _peak(relevancy)


def _paper_masks(
    engine: QueryEngine, view: View, answers: Sequence[QueryResult]
) -> Iterator[tuple[Array, tuple[int, int]]]:
    """Yield masks and peaks in the paper's order: pixels are decoded, at each level once for all phrases."""
    maps: dict[int, Array] = {}
    for level in {answer.level for answer in answers}:
        rows = [row for row, answer in enumerate(answers) if answer.level == level]
        vectors = engine.texts.of([answers[row].phrase for row in rows])
        decoded = decoded_relevancy(view, engine.field, level, vectors, PictureConfig().alpha_gate)
        maps |= dict(zip(rows, np.moveaxis(decoded, 2, 0), strict=True))
    for row, answer in enumerate(answers):
        yield _smoothed_mask(maps[row] > half_way(answer.peak)), _peak(maps[row])


def half_way(peak: float) -> float:
    """Return the relevancy above which values belong to an answer in the paper's order.

    Half way between the floor, no better than the canonical phrases, and the scene's smoothed peak.
    """
    return FLOOR + 0.5 * max(peak - FLOOR, SPAN)


def majority(mask: Array, window: int = 7) -> Array:
    """Return (H, W) boolean mask after a `window` x `window` majority vote; a tie is False."""
    return uniform_filter(mask.astype(np.float64), size=window, mode="nearest") > 0.5 + 1e-9


def _smoothed_mask(mask: Array) -> Array:
    return majority(mask, round(VOTE * len(mask) / PAPER_ROWS) | 1)


def _peak(relevancy: Array) -> tuple[int, int]:
    column, row, _ = peak_pixel(relevancy, round(FILTER * len(relevancy) / PAPER_ROWS))
    return row, column


def evaluate_direct(asked: Asked, labels: Array, truth: Truth) -> list[DirectScore]:
    """The overlap without any view. labels: (3, N) the true id of every Gaussian at each level, -1 for those
    that no photograph shows, which count on neither side (see `oracles.true_labels`)."""
    seen = np.asarray((labels >= 0).any(axis=0))
    results: dict[str, list[tuple[float, float]]] = {}
    for phrase in truth.phrases:
        right = _mask(labels, phrase)[seen]
        if phrase.text not in asked.answers or right.sum() < MIN_GAUSSIANS:
            continue
        answer = asked.answers[phrase.text]
        overlap = intersection_over_union(answer.members[seen], right)
        results.setdefault(phrase.kind, []).append((overlap, _ceiling(asked.engine.regions, seen, right)))
    return [DirectScore(*row) for row in _means(results)]


def _ceiling(regions: Regions, seen: Array, right: Array) -> float:
    """The largest overlap of a union of one level's regions with `right`, of the `seen` Gaussians; regions
    are taken in the order of the share that is right."""
    best = 0.0
    for everywhere in regions.everywhere[:, seen]:
        near = everywhere >= 0
        sizes = np.bincount(everywhere[near])
        hits = np.bincount(everywhere[near & right], minlength=len(sizes))
        order = np.argsort(-hits / np.maximum(sizes, 1), kind="stable")
        hit, size = np.cumsum(hits[order]), np.cumsum(sizes[order])
        best = max(best, float((hit / (size + right.sum() - hit)).max(initial=0)))
    return best


def found_rate(asked: Asked, texts: Iterable[str]) -> tuple[float, int]:
    """Share of `texts` that were answered with a place, and of how many; unknown phrases do not count."""
    found = [asked.answers[text].found for text in texts if text in asked.answers]
    return (float(np.mean(found)) if found else 0.0), len(found)


@dataclass(frozen=True)
class Measured:
    """One variant of the method in one room."""

    scores: tuple[Score, ...]
    direct: tuple[DirectScore, ...]
    accepted: float  # share of the room's objects that are answered with a place
    objects: int  # that were asked
    rejected: float  # share of absent objects that are answered with "not here"
    absent: int  # that were asked
    separation: float  # chance that a present object's peak exceeds an absent one's
    peaks: dict[str, float]  # smoothed peak relevancy of every object that was asked, absent ones included
    unknown: tuple[str, ...]  # phrases left out, because the encoder was never taught their words
    query_ms: float  # median, from text to place
    name: str = ""
    masks: str = ""
    vectors: str = ""
    codec: str = ""
    query: str = ""
    bytes_per_gaussian: float = 0.0  # of its language features
    codec_loss: CodecReport = CodecReport(1.0, 0.0, 0.0)  # noqa: RUF009 (frozen)
    fit_seconds: float = 0.0  # from masks to latents; what an earlier run has made is not in it
    frame_ms: float = 0.0  # median, one phrase into one view


def measured(
    asked: Asked, truth: Truth, absent: Sequence[str], scores: Sequence[Score], direct: Sequence[DirectScore]
) -> Measured:
    present = [phrase.text for phrase in truth.phrases if phrase.kind == "object"]
    accepted, objects = found_rate(asked, present)
    found, count = found_rate(asked, absent)
    known = [text for text in [*present, *absent] if text in asked.answers]
    peaks = {text: round(asked.answers[text].peak, 4) for text in known}
    inside, outside = (np.array([peaks[t] for t in texts if t in peaks]) for texts in (present, absent))
    return Measured(
        scores=tuple(scores),
        direct=tuple(direct),
        accepted=accepted,
        objects=objects,
        rejected=1 - found,
        absent=count,
        separation=separation(inside, outside),
        peaks=peaks,
        unknown=asked.unknown,
        query_ms=1000 * asked.seconds,
    )


def separation(present: Array, absent: Array) -> float:
    """Chance that one of `present` (P,) exceeds one of `absent` (A,), ties half; 1 without either."""
    if len(present) == 0 or len(absent) == 0:
        return 1.0
    return float((present[:, None] > absent).mean() + 0.5 * (present[:, None] == absent).mean())


def grouped(rows: Iterable[Row], *names: str) -> dict[Any, list[Row]]:
    """Rows by what these fields of theirs hold, in the order in which it first comes."""
    found: dict[Any, list[Row]] = {}
    for row in rows:
        found.setdefault(attrgetter(*names)(row), []).append(row)
    return found


def spread(values: Array) -> str:
    """Mean of percentages, with the standard deviation of several, as cells of tables have them."""
    deviation = f" +/- {values.std(ddof=1):.1f}" if len(values) > 1 else ""
    return f"{values.mean():.1f}{deviation}" if len(values) else "-"


def of_kind(measured: Measured, kind: str) -> tuple[int, float, float, float]:
    """Queries, mean IoU, localisation and 3-D IoU of one kind of phrase, or of all; 0 of nothing."""
    rows = [score for score in measured.scores if kind in (score.kind, "all")]
    count = sum(score.queries for score in rows)
    weights = [score.queries / max(count, 1) for score in rows]
    shares = np.dot(weights, np.reshape([(s.mean_iou, s.localisation) for s in rows], (-1, 2))).tolist()
    return count, *shares, direct_share(measured, kind, "mean_iou")


def loss_cells(measured: Sequence[Measured]) -> tuple[str, str, str]:
    """Codec, its relevancy error, and its bytes per Gaussian, means over the rooms."""
    mean = np.mean([m.codec_loss.error_mean for m in measured])
    p99 = np.mean([m.codec_loss.error_p99 for m in measured])
    names = dict.fromkeys(m.codec for m in measured)
    bytes_each = np.mean([m.bytes_per_gaussian for m in measured])
    return ", ".join(names), f"{mean:.4f} / {p99:.3f}", f"{bytes_each:.0f}"


def direct_share(measured: Measured, kind: str, name: Literal["mean_iou", "ceiling"]) -> float:
    """Mean over the phrases of a kind, or of all, among the Gaussians."""
    scores = [score for score in measured.direct if kind in (score.kind, "all")]
    count = sum(score.phrases for score in scores)
    return float(sum(getattr(score, name) * score.phrases for score in scores) / max(count, 1))
