"""A scene against the ground truth of the procedural room it was photographed in.

Scores follow LERF and LangSplat: localisation (is the peak of the mean-filtered relevancy map on the
thing?) and segmentation (intersection over union), per view and phrase, averaged per kind of phrase; and
rejection: how many absent objects are answered with "not here".
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import PictureConfig
from langsplat_core.errors import InputError
from langsplat_core.evaluation.metrics import intersection_over_union, majority
from langsplat_core.progress import Progress, silent
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.localize import peak_pixel
from langsplat_core.query.pixels import decoded_relevancy, splatted_relevancy
from langsplat_core.raster.protocol import Rasterizer, View
from langsplat_core.scene import Camera

MIN_PIXELS = 150  # a thing with fewer visible pixels in a view is not asked for there
FILTER = 20  # px, the paper's mean filter for localisation


@dataclass(frozen=True)
class Phrase:
    """A phrase and what it is true for."""

    text: str
    kind: str  # "object", "colour+object", "part"
    ids: tuple[int, ...]  # truth ids, of any level


@dataclass(frozen=True, eq=False)
class Truth:
    """What `langsplat demo dataset` knows about its photographs."""

    folder: Path
    phrases: tuple[Phrase, ...]
    things: frozenset[str]  # object words present

    def labels(self, name: str) -> Array:
        """(3, H, W) ids of the photograph with this stem, -1 where nothing is."""
        with np.load(self.folder / f"{name}.npz", allow_pickle=False) as stored:
            return np.asarray(stored["ids"]).astype(np.int64)


@dataclass(frozen=True)
class Score:
    """One kind of phrase."""

    kind: str
    queries: int  # (view, phrase) pairs
    mean_iou: float
    localisation: float  # share of pairs whose peak lies on the thing


def read_truth(dataset: Path) -> Truth:
    """The truth beside the photographs; InputError where there is none."""
    folder = dataset / "truth"
    if not (folder / "labels.json").is_file():
        raise InputError(f"{dataset}: no truth/labels.json; make one with `langsplat demo dataset --out DIR`")
    labels = json.loads((folder / "labels.json").read_text())
    phrases: dict[str, Phrase] = {}
    for item in labels.values():
        for text, kind in _asked(item):
            ids = tuple(int(key) for key, other in labels.items() if text in other["words"])
            phrases.setdefault(text, Phrase(text, kind, ids))
    things = frozenset(item["thing"] for item in labels.values() if item["thing"])
    return Truth(folder, tuple(phrases.values()), things)


def _asked(item: dict[str, str]) -> Iterator[tuple[str, str]]:
    """The phrases that are asked about one region: (text, kind)."""
    if item["level"] == "whole" and item["thing"]:
        yield item["thing"], "object"
        if item["colour"]:
            yield f"{item['colour']} {item['thing']}", "colour+object"
    elif item["level"] == "part" and item["word"] not in ("", item["thing"], "body"):
        yield f"{item['thing']} {item['word']}", "part"


def evaluate(
    engine: QueryEngine,
    rasterizer: Rasterizer,
    cameras: Sequence[Camera],
    truth: Truth,
    paper_order: bool = False,
    progress: Progress = silent,
) -> list[Score]:
    """Ask every phrase in every view where its thing is visible. `paper_order` decodes pixels instead."""
    answers = {phrase: engine.run(phrase.text) for phrase in truth.phrases}
    results: dict[str, list[tuple[float, bool]]] = {}
    gate = PictureConfig().alpha_gate
    for done, camera in enumerate(cameras):
        labels = truth.labels(camera.name)
        view = rasterizer.view(engine.scene.gaussians, camera, engine.scene.raster_settings())
        visible = [p for p in truth.phrases if _mask(labels, p).sum() >= MIN_PIXELS]
        for phrase in visible:
            answer = answers[phrase]
            if paper_order:
                vector = engine.text_vector(phrase.text)[None]
                relevancy = decoded_relevancy(view, engine.field, answer.level, vector, gate)[..., 0]
            else:
                relevancy = _splat(view, answer.relevancy[answer.level], gate)
            results.setdefault(phrase.kind, []).append(_judge(relevancy, answer.peak, _mask(labels, phrase)))
        progress("asking phrases", (done + 1) / len(cameras))
    return [
        Score(kind, len(rows), float(np.mean([r[0] for r in rows])), float(np.mean([r[1] for r in rows])))
        for kind, rows in sorted(results.items())
    ]


def _splat(view: View, values: Array, gate: float) -> Array:
    relevancy: Array = splatted_relevancy(view, values[:, None], gate)[..., 0]
    return relevancy


def _mask(labels: Array, phrase: Phrase) -> Array:
    return np.asarray(np.isin(labels, phrase.ids).any(axis=0))


def _judge(relevancy: Array, peak: float, truth: Array) -> tuple[float, bool]:
    """IoU of the map cut half way between the floor 0.5 and the scene's peak, and whether its peak hits."""
    found = majority(relevancy > 0.5 + 0.5 * max(peak - 0.5, 0.02))
    column, row, _ = peak_pixel(relevancy, FILTER)
    return intersection_over_union(found, truth), bool(truth[row, column])


def rejection_rate(engine: QueryEngine, absent: Sequence[str]) -> float:
    """Share of absent objects that are answered with "not here"."""
    return float(np.mean([not engine.run(phrase).found for phrase in absent])) if absent else 1.0
