"""Reports on what answers rest on: `votes`, whether evidence tells wrong votes and answers, and `taught`,
words that were shown instead of written."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np

from assets.making.objects import EVERYTHING
from langsplat_core.arrays import Array
from langsplat_core.config import CodebookConfig, CodecConfig, Count
from langsplat_core.extensions.benchmarks.measure import markdown
from langsplat_core.extensions.benchmarks.report import intersection_over_union
from langsplat_core.pipeline.evidence import FEW, find_evidence
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.engine import QueryEngine
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.scene import LEVELS, Scene, TaughtWord
from tests.benchmarks.room import InRooms, MaskOrigin, Room, Variant, publish
from tests.benchmarks.scoring import MIN_GAUSSIANS, grouped, separation, spread

RIGHT = 0.5  # of the best region's Gaussians are of what the phrase names


@dataclass(frozen=True)
class Votes(InRooms):
    """Evidence of every thing that is found: is a mask with another region's vector the worst vote, and do
    votes and fits tell answers that are right from answers that are wrong?"""

    masks: tuple[MaskOrigin, ...] = ("wrong", "graph")  # where outlines and vectors come from

    def run(self) -> None:
        rows = self.each(lambda room: [row for masks in self.masks for row in measure_evidence(room, masks)])
        tables = f"{vote_table(rows)}\n{answer_table(rows)}"
        publish(self, "votes", "Evidence: wrong votes and wrong answers", tables, rows)


@dataclass(frozen=True)
class Explained:
    """The evidence of one answer that was found."""

    seed: int
    masks: str
    text: str
    right: bool
    probability: float | None
    share: float  # of votes, see `Evidence`
    fitting: float  # share of the photographs that show it whose mask votes for it and fits the phrase
    fits: tuple[float, ...]  # of the votes for it, the best first
    replaced: tuple[bool, ...]  # whether each mask has another region's vector


def measure_evidence(room: Room, masks: MaskOrigin) -> Iterator[Explained]:
    """Every thing that is there and every thing that is not, as far as it is found."""
    variant = Variant("the method", masks)
    views = room.views(variant)
    true = room.views(Variant("the method", "truth")) if masks == "wrong" else views
    engine = room.engine(variant, [camera for camera, _ in views])
    asked = {phrase.text: phrase.ids for phrase in room.truth.phrases if phrase.kind == "object"}
    asked |= dict.fromkeys(room.truth.absent(EVERYTHING), ())
    known = [text for text in asked if not engine.unknown_words(text)]
    features = [seen for _, seen in views]
    for text, answer in zip(known, engine.run_many(known), strict=True):
        found = find_evidence(engine, answer, [text], features, CpuRasterizer()) if answer.found else None
        if found is None:
            continue
        own = np.isin(room.labels[:, found.members], np.array(asked[text], np.int64)).any(axis=0)
        yield Explained(
            seed=room.seed,
            masks=masks,
            text=text,
            right=bool(own.mean() >= RIGHT),
            probability=answer.probability,
            share=found.share,
            fitting=found.fitting / max(len(found.votes) + len(found.others), 1),
            fits=tuple(cast(float, vote.fit) for vote in found.votes),
            replaced=tuple(
                not np.array_equal(views[v.view][1].vectors[v.mask], true[v.view][1].vectors[v.mask])
                for v in found.votes
            ),
        )


def vote_table(rows: Sequence[Explained]) -> str:
    """Markdown: how well fits tell votes of masks with another region's vector."""
    head = ("masks", "votes", "wrong ones", "ROC area of fits %", f"wrong ones among the worst {FEW} %")
    lines = []
    for masks, here in grouped([row for row in rows if any(row.replaced)], "masks").items():
        fits = np.concatenate([row.fits for row in here])
        wrong = np.concatenate([row.replaced for row in here]).astype(bool)
        drawn = sum(sum(row.replaced[-FEW:]) for row in here) / wrong.sum()
        worst = np.mean([row.replaced[-1] for row in here])
        shares = (separation(fits[~wrong], fits[wrong]), drawn, worst)
        lines.append((masks, len(fits), int(wrong.sum()), *(f"{100 * share:.1f}" for share in shares)))
    return markdown((*head, "worst vote is a wrong one, where there is any %"), lines)


def answer_table(rows: Sequence[Explained]) -> str:
    """Markdown: how well each figure tells answers that are right from answers that are wrong."""
    names = ("probability", "share", "fitting")
    head = ("masks", "found", "right", *(f"ROC area of {name} %" for name in names))
    lines = []
    for masks, here in grouped(rows, "masks").items():
        right = np.array([row.right for row in here])
        values = [np.array([getattr(row, name) for row in here], float) for name in names]
        areas = [f"{100 * separation(one[right], one[~right]):.1f}" for one in values]
        lines.append((masks, len(here), int(right.sum()), *(["-"] * len(names) if right.all() else areas)))
    return markdown(head, lines)


# Words that were taught by showing in one room, asked for in the others. In every room one thing of each kind
# is shown, the region that holds most of its Gaussians, and asked for in every other room: where a thing of
# its kind is, and where none is. Colours and shapes of a kind differ between rooms, so that things of the
# same colour are also counted alone.

WHOLE = LEVELS.index("whole")


@dataclass(frozen=True)
class Taught(InRooms):
    """Things that were shown in other rooms, asked for by the name they were given there: accept and reject
    rates, and whether the answer is the right thing."""

    masks: MaskOrigin = "truth"  # where outlines come from
    codec: CodecConfig = field(default_factory=CodebookConfig)
    examples: tuple[Count, ...] = (1, 3)  # rooms in which each thing is shown
    whole_vectors: bool = False  # compared, and not what of them is a matter of words

    def run(self) -> None:
        variant = Variant("the method", self.masks, codec=self.codec)
        rooms = self.each(lambda room: [Shown(room, variant, self.whole_vectors)])
        rows = [row for count in self.examples for row in measure_taught(rooms, count)]
        publish(self, "taught", "Taught by showing in one room, asked in others", taught_table(rows), rows)


class Shown:
    """A room, and a word for one thing of each kind in it."""

    def __init__(self, room: Room, variant: Variant, whole_vectors: bool = False) -> None:
        self.room, self.truth = room, room.truth
        field = room.field(variant)[0]
        scene = Scene(room.gaussians, replace(field, everyday=None) if whole_vectors else field)
        self.seen = np.asarray((room.labels >= 0).any(0))
        self.engine, whole = QueryEngine(scene), room.labels[WHOLE]
        self.words: dict[str, tuple[TaughtWord, str]] = {}  # by kind, with the colour of what was shown
        regions = self.truth.regions
        for kind in sorted({region.thing for region in regions.values() if region.thing}):
            ids = [n for n, r in regions.items() if r.level == "whole" and r.thing == kind]
            largest = max(ids, key=lambda number: int((whole == number).sum()), default=-1)
            if (whole == largest).sum() >= MIN_GAUSSIANS:
                of = self.engine.regions.everywhere[WHOLE]
                region = int(np.bincount(of[(whole == largest) & (of >= 0)]).argmax())
                word = self.engine.teach(f"taught {kind}", of == region, "whole")
                self.words[kind] = word, regions[largest].colour

    def there(self, text: str) -> Array:
        """(N,) bool: what a phrase is true for; too few Gaussians are nothing."""
        ids = [n for n, region in self.truth.regions.items() if text in region.words]
        right = np.asarray(np.isin(self.room.labels, ids).any(0))
        return np.asarray(right & (right.sum() >= MIN_GAUSSIANS))


@dataclass(frozen=True)
class TaughtRow:
    """One word, asked in one room that it was not taught in."""

    tier: str
    seed: int
    kind: str
    examples: int
    there: bool  # a thing of this kind
    alike: bool  # one of the same kind and colour as an example
    found: bool
    excess: float
    right: bool  # most of the best region is a thing of this kind
    iou: float  # 3D, of all members with all things of this kind


def measure_taught(rooms: Sequence[Shown], examples: int) -> Iterator[TaughtRow]:
    """Words of so many rooms each, asked in every other room where it is known whether the kind is there."""
    for asked in rooms:
        others = [room for room in rooms if room is not asked]
        absent = set(asked.truth.absent(EVERYTHING))
        for kind in sorted({kind for room in others for kind in room.words}):
            right = asked.there(kind)
            if not right.any() and kind not in absent:
                continue
            known = [room.words[kind] for room in others if kind in room.words]
            for first in range(0, len(known) - examples + 1, examples):
                words, colours = zip(*known[first : first + examples], strict=True)
                word = joined(words)
                asked.engine.taught = {word.key: word}
                result = asked.engine.run(word.name)
                alike = any(asked.there(f"{colour} {kind}").any() for colour in colours if colour)
                yield scored(asked, kind, examples, alike, result, right)


def joined(words: Sequence[TaughtWord]) -> TaughtWord:
    """One word with the examples of all."""
    vectors, rivals = (
        np.concatenate([getattr(word, part) for word in words]) for part in ("vectors", "rivals")
    )
    return replace(words[0], vectors=vectors, rivals=rivals)


def scored(
    asked: Shown, kind: str, examples: int, alike: bool, result: QueryResult, right: Array
) -> TaughtRow:
    """An answer compared with the truth. right: (N,) bool."""
    seen = asked.seen
    best = result.members & seen & (result.even == result.even[result.members].max(initial=0))
    return TaughtRow(
        tier=asked.room.tier,
        seed=asked.room.seed,
        kind=kind,
        examples=examples,
        there=bool(right.any()),
        alike=alike,
        found=result.found,
        excess=float(result.excess or 0),
        right=bool(best.any() and right[best].mean() > 0.5),
        iou=intersection_over_union(result.members[seen], right[seen]),
    )


def taught_table(rows: Sequence[TaughtRow]) -> str:
    """Markdown: means over rooms with their standard deviation."""
    head = (
        *("tier", "shown in", "asked for", "words", "accepted %", "right of these %"),
        *("best region right %", "3D IoU %", "absent rejected %"),
    )
    lines = []
    for (tier, examples), group in grouped(rows, "tier", "examples").items():
        where = f"{examples} room{'s' if examples > 1 else ''}"
        for name, chosen in (
            ("same kind", [row for row in group if row.there]),
            ("same kind and colour", [row for row in group if row.alike]),
        ):
            cells = (
                _cell(chosen, lambda row: row.found),
                _cell([row for row in chosen if row.found], lambda row: row.right),
                _cell(chosen, lambda row: row.right),
                _cell(chosen, lambda row: row.iou),
                _cell([row for row in group if not row.there], lambda row: not row.found),
            )
            lines.append((tier, where, name, len(chosen), *cells))
    return markdown(head, lines)


def _cell(rows: Sequence[TaughtRow], share: Callable[[TaughtRow], float]) -> str:
    """Of the means over the words of each room."""
    rooms = grouped(rows, "seed").values()
    return spread(100 * np.array([np.mean([share(row) for row in room], dtype=float) for room in rooms]))
