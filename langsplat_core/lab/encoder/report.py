"""How well the demo encoder does on rooms it was not trained in: retrieval and relevancy."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.lab.encoder.crops import CropSet
from langsplat_core.lab.encoder.phrases import KINDS, PhraseBook, phrase_book
from langsplat_core.scene import CANONICAL_PHRASES
from langsplat_core.semantics.relevancy import FLOOR, relevancy


class Encoder(Protocol):
    """What is measured; `semantics.encoders.Encoder` is one."""

    def encode_images(self, crops: Array, batch: int = 64) -> Array:
        """(M, D) unit vectors of (M, S, S, 3) uint8 pictures."""

    def encode_texts(self, texts: list[str]) -> Array:
        """(M, D) unit vectors."""


@dataclass(frozen=True)
class KindReport:
    """Figures for the phrases of one kind."""

    kind: str  # one of KINDS
    crops: int  # crops with at least one right phrase of this kind
    phrases: int  # that compete
    top1: float  # share of crops whose best phrase of this kind is a right one
    right: tuple[float, float, float]  # relevancy of right pairs: 10 %, 50 %, 90 % quantile
    right_found: float  # share of right pairs with relevancy >= the floor
    wrong_found: float  # share of wrong pairs with relevancy >= the floor
    separation: float  # probability that a right pair has more relevancy than a wrong one (ROC area)


def report(encoder: Encoder, crops: CropSet, book: PhraseBook | None = None) -> list[KindReport]:
    """Figures on `crops`, one row per kind of phrase that some crop has a right one of.

    Pairs that are neither right nor wrong are left out. `book`: the phrases; None: those of the crops.
    """
    book = book or phrase_book(list(crops.labels))
    images = encoder.encode_images(crops.images)
    texts = encoder.encode_texts(list(book.phrases))
    canonical = encoder.encode_texts(list(CANONICAL_PHRASES))
    row_of = {label: row for row, label in enumerate(book.labels)}
    fits = book.fits[[row_of[label] for label in crops.labels]]
    kinds = np.array(book.kinds)
    rows = []
    for kind in KINDS:
        columns = np.flatnonzero(kinds == kind)
        if (fits[:, columns] == 1).any():
            scores = relevancy(images, texts[columns], canonical)
            rows.append(_kind_report(kind, scores, fits[:, columns]))
    return rows


def _kind_report(kind: str, scores: Array, fits: Array) -> KindReport:
    usable = (fits == 1).any(1)
    scores, fits = scores[usable], fits[usable]
    best = np.where(fits >= 0, scores, -1.0).argmax(1)
    right, wrong = scores[fits == 1], scores[fits == 0]
    low, middle, high = np.quantile(right, (0.1, 0.5, 0.9))
    sorted_wrong = np.sort(wrong)
    return KindReport(
        kind,
        len(scores),
        scores.shape[1],
        float((fits[np.arange(len(fits)), best] == 1).mean()),
        (float(low), float(middle), float(high)),
        float((right >= FLOOR).mean()),
        float((wrong >= FLOOR).mean()),
        float(np.searchsorted(sorted_wrong, right).mean() / len(wrong)),
    )
