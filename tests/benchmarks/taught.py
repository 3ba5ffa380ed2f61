"""The report `taught`: words that were taught by showing in one room, asked for in the others.

In every room one thing of each kind is shown, the region that holds most of its Gaussians, and asked for in
every other room: where a thing of its kind is, and where none is. Colours and shapes of a kind differ between
rooms, so that things of the same colour are also counted alone.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from assets.making.objects import EVERYTHING
from langsplat_core.arrays import Array
from langsplat_core.bench.measure import markdown
from langsplat_core.config import CodebookConfig, CodecConfig, Count
from langsplat_core.evaluation.report import intersection_over_union
from langsplat_core.progress import TerminalProgress
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.engine import QueryEngine
from langsplat_core.scene import LEVELS, Scene, TaughtWord
from tests.benchmarks.room import InRooms, MaskOrigin, Room, Variant, publish
from tests.benchmarks.scoring import MIN_GAUSSIANS
from tests.benchmarks.verdicts import spread

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
        with TerminalProgress() as progress:
            variant = Variant("the method", self.masks, codec=self.codec)
            rooms = [Shown(room, variant, self.whole_vectors) for room in self.rooms(progress)]
        rows = [row for count in self.examples for row in measure_taught(rooms, count)]
        publish(self, "taught", "Taught by showing in one room, asked in others", taught_table(rows), rows)


class Shown:
    """A room, and a word for one thing of each kind in it."""

    def __init__(self, room: Room, variant: Variant, whole_vectors: bool = False) -> None:
        self.room, self.truth = room, room.truth
        field = room.field(variant)[0]
        self.scene = Scene(room.gaussians, replace(field, everyday=None) if whole_vectors else field)
        self.seen = np.asarray((room.labels >= 0).any(0))
        engine, whole = QueryEngine(self.scene), room.labels[WHOLE]
        self.words: dict[str, tuple[TaughtWord, str]] = {}  # by kind, with the colour of what was shown
        for kind in sorted({region.thing for region in self.truth.regions.values() if region.thing}):
            regions = self.truth.regions
            ids = [n for n, r in regions.items() if r.level == "whole" and r.thing == kind]
            largest = max(ids, key=lambda number: int((whole == number).sum()), default=-1)
            if (whole == largest).sum() >= MIN_GAUSSIANS:
                of = engine.regions.everywhere[WHOLE]
                region = int(np.bincount(of[(whole == largest) & (of >= 0)]).argmax())
                word = engine.teach(f"taught {kind}", of == region, "whole")
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
                result = ask(asked, joined(words))
                alike = any(asked.there(f"{colour} {kind}").any() for colour in colours if colour)
                yield scored(asked, kind, examples, alike, result, right)


def joined(words: Sequence[TaughtWord]) -> TaughtWord:
    """One word with the examples of all."""
    vectors, rivals = (
        np.concatenate([getattr(word, part) for word in words]) for part in ("vectors", "rivals")
    )
    return replace(words[0], vectors=vectors, rivals=rivals)


def ask(asked: Shown, word: TaughtWord) -> QueryResult:
    """The answer to a taught word in another room."""
    field = asked.scene.language
    assert field is not None
    engine = asked.__dict__.setdefault("engine", QueryEngine(asked.scene))
    engine.taught = {word.key: word}
    return engine.run(word.name)


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
    for tier, examples in dict.fromkeys((row.tier, row.examples) for row in rows):
        group = [row for row in rows if (row.tier, row.examples) == (tier, examples)]
        rejected = _cell(group, lambda row: np.nan if row.there else not row.found)
        for name, chosen in (
            ("same kind", [row for row in group if row.there]),
            ("same kind and colour", [row for row in group if row.alike]),
        ):
            cells = (
                _cell(chosen, lambda row: row.found),
                _cell(chosen, lambda row: row.right if row.found else np.nan),
                _cell(chosen, lambda row: row.right),
                _cell(chosen, lambda row: row.iou),
            )
            where = f"{examples} room{'s' if examples > 1 else ''}"
            lines.append((tier, where, name, len(chosen), *cells, rejected))
    return markdown(head, lines)


def _cell(rows: Sequence[TaughtRow], share: Callable[[TaughtRow], float]) -> str:
    """Of the means over the words of each room; NaN does not count."""
    shares = []
    for seed in dict.fromkeys(row.seed for row in rows):
        values = np.array([share(row) for row in rows if row.seed == seed], float)
        shares.append(100 * values[np.isfinite(values)].mean() if np.isfinite(values).any() else np.nan)
    return spread(np.array(shares)[np.isfinite(shares)])
