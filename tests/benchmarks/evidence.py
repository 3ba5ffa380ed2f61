"""The report `votes`: whether the evidence of answers tells wrong votes and wrong answers."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from assets.making.objects import EVERYTHING
from langsplat_core.extensions.benchmarks.measure import markdown
from langsplat_core.pipeline.evidence import FEW, find_evidence
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from tests.benchmarks.room import InRooms, MaskOrigin, Room, Variant, publish
from tests.benchmarks.scoring import grouped, separation

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
