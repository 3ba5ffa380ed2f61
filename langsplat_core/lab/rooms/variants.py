"""The error budget of the benchmark: the method, and the method with one stage swapped."""

from dataclasses import dataclass, replace
from typing import Literal

from langsplat_core.lab.config import MaskOrigin


@dataclass(frozen=True)
class Variant:
    """Which stages are the method's own, and which make no mistake."""

    name: str
    masks: MaskOrigin
    vectors: Literal["image", "text"] = "image"  # text: of every region's true words
    codec: Literal["autoencoder", "linear"] = "autoencoder"  # linear: of `WIDE` numbers
    query: Literal["table", "exact", "paper"] = "table"


def variants(masks: MaskOrigin, budget: bool) -> list[Variant]:
    """The method first; with `budget`, then one variant per stage, which differs in that stage alone."""
    method = Variant("the method", masks)
    if not budget:
        return [method]
    perfect = [replace(method, name="perfect masks", masks="truth")] if masks != "truth" else []
    return [
        method,
        *perfect,
        replace(method, name="perfect embeddings", vectors="text"),
        replace(method, name="no codec", codec="linear"),
        replace(method, name="exact query", query="exact"),
        replace(method, name="the paper's order", query="paper"),
    ]
