"""The report `rooms`: answers in fresh rooms with known truth, and an error budget, which swaps one stage at
a time for one that makes no mistake."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from assets.making.config import TIERS, Tier
from assets.making.objects import EVERYTHING
from assets.making.truth import PHRASE_KINDS, read_truth
from langsplat_core.bench.measure import markdown
from langsplat_core.config import CodebookConfig, CodecConfig, Count, DatasetConfig, LiftConfig
from langsplat_core.datasets import load_capture
from langsplat_core.errors import InputError
from langsplat_core.io.scenes import load_scene
from langsplat_core.progress import Progress, TerminalProgress, silent
from langsplat_core.query.engine import QueryEngine, no_field
from langsplat_core.raster import load_rasterizer
from langsplat_core.semantics.encoders import load_text_encoder
from langsplat_core.training.radiance.train import evaluate_views
from tests.benchmarks.room import (
    HOLD_OUT,
    InRooms,
    MaskOrigin,
    Room,
    Seeds,
    Variant,
    autoencoder,
    ceiling,
    publish,
)
from tests.benchmarks.scoring import (
    MaskRule,
    Measured,
    ask,
    direct_share,
    evaluate,
    found_rate,
    loss_cells,
    of_kind,
)

WHOLE = DatasetConfig(max_side=65_536)  # photographs are not shrunk


@dataclass(frozen=True)
class Rooms(InRooms):
    """Localisation, segmentation and rejection in procedural rooms, in views that training did not see.

    Without --scene, fresh rooms are rendered and trained first, some minutes each; an interrupted run
    continues where it stopped."""

    tiers: tuple[Tier, ...] = TIERS  # how crowded the rooms are
    seeds: Seeds = (101,)
    """One room of every tier each; never the bundled scene's."""
    masks: MaskOrigin = "truth"  # where outlines come from
    codec: CodecConfig = field(default_factory=CodebookConfig)
    lift: LiftConfig = field(default_factory=LiftConfig)
    budget: bool = False  # also swap one stage at a time for one that makes no mistake
    codec_steps: Count = 4_000  # of training the autoencoder of --budget
    scene: Path | None = None
    """Measure this scene, trained on --dataset, instead of fresh rooms; of the settings, --cut applies."""
    dataset: Path | None = None
    """The room that --scene shows, as written by `python -m assets.making dataset`."""
    paper_order: bool = False
    """With --scene: blend latents and decode every pixel, as the paper does, not the relevancies."""

    def run(self) -> None:
        if (self.scene is None) != (self.dataset is None):
            raise InputError("--scene and --dataset belong together: a scene, and the room it was trained on")
        with TerminalProgress() as progress:
            if self.scene is not None and self.dataset is not None:
                rule = MaskRule(self.paper_order, self.settings.cut)
                print(measure_scene(self.scene, self.dataset, rule, progress))
                return
            if self.paper_order:
                raise InputError(
                    "--paper-order needs --scene; for fresh rooms, --budget measures it beside ours"
                )
            reports = [room_report(room, variants(self, room.encoder.dim)) for room in self.rooms(progress)]
        tables = [score_table(reports), room_table(reports)]
        if self.budget:
            tables.append(budget_table(reports))
        unknown = sum(len(report.measured[0].unknown) for report in reports)
        if unknown:
            tables.append(f"left out: {unknown} phrases with words that the encoder was never taught\n")
        publish(self, "rooms", "Rooms with known truth", "\n".join(tables), reports)


@dataclass(frozen=True)
class RoomReport:
    """Figures of one room."""

    tier: str
    seed: int
    views: int  # trained on
    held_out: int
    gaussians: int
    psnr: float  # mean over held-out views, dB
    encoder: str
    cut: str
    measured: tuple[Measured, ...]  # the method first
    seconds: dict[str, float]  # per stage, of this run: a stage that was already done takes almost none


def variants(command: Rooms, dim: int) -> list[Variant]:
    """The method first; then, with --budget, one variant per stage, which differs in that stage alone.
    dim: numbers of the encoder's vectors."""
    method = Variant("the method", command.masks, codec=command.codec, lift=command.lift)
    if not command.budget:
        return [method]
    perfect = [replace(method, name="perfect masks", masks="truth")] if command.masks != "truth" else []
    decoded = replace(method, name="autoencoder, d = 3", codec=autoencoder(steps=command.codec_steps))
    return [
        method,
        *perfect,
        replace(method, name="perfect embeddings", vectors="text"),
        replace(method, name="no codec", codec=ceiling(dim)),
        decoded,
        replace(decoded, name="autoencoder, the paper's order", query="paper"),
    ]


def room_report(room: Room, chosen: Sequence[Variant]) -> RoomReport:
    """Measure the variants in one room."""
    _, held_out = room.capture.split(HOLD_OUT)
    rows = [room.measure(variant) for variant in chosen]
    views = evaluate_views(room.gaussians, room.capture, held_out)
    return RoomReport(
        tier=room.tier,
        seed=room.seed,
        views=len(room.capture) - len(held_out),
        held_out=len(held_out),
        gaussians=len(room.gaussians),
        psnr=float(np.mean([view.psnr for view in views])),
        encoder=room.encoder.id,
        cut=room.config.cut,
        measured=tuple(rows),
        seconds=room.seconds,
    )


def score_table(reports: Sequence[RoomReport]) -> str:
    """Markdown: the method, per tier and kind of phrase: means over the rooms, and the standard deviation
    between them where there are several."""
    head = ("tier", "phrases", "queries", "mIoU %", "localisation %", "3D IoU %", "right regions: 3D IoU %")
    lines = []
    for tier, rooms in _by_tier(reports):
        for kind in (*PHRASE_KINDS, "all"):
            of_rooms = [of_kind(room.measured[0], kind) for room in rooms]
            count = sum(queries for queries, *_ in of_rooms)
            if count:
                spreads = [_spread(values) for values in zip(*(row[1:] for row in of_rooms), strict=True)]
                ceilings = [direct_share(room.measured[0], kind, "ceiling") for room in rooms]
                spreads.append(_spread(ceilings) if any(ceilings) else "-")
                lines.append((tier, kind, count, *spreads))
    return markdown(head, lines)


def _spread(shares: Sequence[float]) -> str:
    """Percent, with the standard deviation of several."""
    if len(shares) == 1:
        return _percent(shares[0])
    return f"{_percent(float(np.mean(shares)))} +/- {_percent(float(np.std(shares, ddof=1)))}"


def room_table(reports: Sequence[RoomReport]) -> str:
    """Markdown: the method, per tier, what is not per kind of phrase."""
    head = ("tier", "Gaussians", "PSNR dB", "objects found", "absent rejected", "separation %")
    lines = []
    for tier, rooms in _by_tier(reports):
        ours = [room.measured[0] for room in rooms]
        objects, absent = sum(m.objects for m in ours), sum(m.absent for m in ours)
        accepted = sum(m.accepted * m.objects for m in ours) / max(objects, 1)
        rejected = sum(m.rejected * m.absent for m in ours) / max(absent, 1)
        lines.append((
            tier,
            round(np.mean([room.gaussians for room in rooms])),
            f"{np.mean([room.psnr for room in rooms]):.1f}",
            f"{_percent(accepted)} % of {objects}",
            f"{_percent(rejected)} % of {absent}",
            _percent(float(np.mean([m.separation for m in ours]))),
            f"{np.median([m.query_ms for m in ours]):.1f}",
            f"{np.median([m.frame_ms for m in ours]):.1f}",
        ))  # fmt: skip
    return markdown((*head, "ms/query", "ms/picture"), lines)


def budget_table(reports: Sequence[RoomReport]) -> str:
    """Markdown: per tier and swapped stage, means over the rooms and the difference to the method, in
    percentage points."""
    head = (
        *("tier", "swapped", "mIoU %", "+/-", "localisation %", "+/-", "3D IoU %", "+/-", "rejected %"),
        *("codec", "relevancy error mean / p99", "bytes/Gaussian"),
    )
    lines = []
    for tier, rooms in _by_tier(reports):
        base = _means(room.measured[0] for room in rooms)
        for row in range(min(len(room.measured) for room in rooms)):
            ours = [room.measured[row] for room in rooms]
            cells = [tier, f"nothing ({ours[0].masks} masks)" if row == 0 else ours[0].name]
            for mean, of_method in zip(_means(ours), base, strict=True):
                cells += [_percent(mean), f"{100 * (mean - of_method):+.1f}" if row else ""]
            rejected = sum(m.rejected * m.absent for m in ours) / max(sum(m.absent for m in ours), 1)
            lines.append((*cells, _percent(rejected), *loss_cells(ours)))
    return markdown(head, lines)


def _means(measured: Iterable[Measured]) -> tuple[float, ...]:
    """Mean IoU, localisation and 3-D IoU over all phrases, mean over the rooms."""
    return tuple(float(x) for x in np.mean([of_kind(m, "all")[1:] for m in measured], axis=0))


def _by_tier(reports: Sequence[RoomReport]) -> Iterator[tuple[str, list[RoomReport]]]:
    for tier in dict.fromkeys(report.tier for report in reports):
        yield tier, [report for report in reports if report.tier == tier]


def _percent(share: float) -> str:
    return f"{100 * share:.1f}"


def measure_scene(scene_path: Path, dataset: Path, rule: MaskRule, progress: Progress = silent) -> str:
    """Every phrase of a room in the views that one given scene of it was not trained on; Markdown.

    dataset: the room, as `python -m assets.making dataset` wrote it. Raises InputError for a scene without a
    language field or without held-out views, and for a dataset without truth.
    """
    scene = load_scene(scene_path)
    if scene.language is None:
        raise InputError(f"{scene_path}: {no_field(scene)}")
    truth = read_truth(dataset)
    trained = {camera.name for camera in scene.cameras}
    capture = load_capture(dataset, WHOLE, dataset, progress)
    held_out = [camera for camera in capture.cameras if camera.name not in trained]
    if not held_out:
        raise InputError(f"{scene_path}: no view was held out from training")
    absent = truth.absent(EVERYTHING)
    texts = [*(phrase.text for phrase in truth.phrases), *absent]
    asked = ask(QueryEngine(scene, load_text_encoder), texts)
    scores = evaluate(asked, load_rasterizer("cpu"), held_out, truth, rule, progress)
    rows = [(s.kind, s.queries, _percent(s.mean_iou), _percent(s.localisation)) for s in scores]
    found, count = found_rate(asked, absent)
    lines = ["", f"absent objects rejected: {100 * (1 - found):.0f} % of {count}"]
    if asked.unknown:
        lines.append(f"left out: {len(asked.unknown)} phrases with words that the encoder was never taught")
    return markdown(("phrases", "queries", "mIoU %", "localisation %"), rows) + "\n".join(lines)
