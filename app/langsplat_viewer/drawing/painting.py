"""What a picture shows of answers: the numbers per Gaussian and how hot they are. The window and pictures
without one both ask here.

A thing that is "not here" is not painted at all, a "weak match" half as strongly as what was found. A
segmentation shows the members of an answer, which are whole regions; a heat map shows raw relevancy.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import Display, PictureConfig
from langsplat_core.display.compose import HeatRanges
from langsplat_core.query.answers import QueryResult, Verdict
from langsplat_core.semantics.relevancy import FLOOR

STRENGTH: Mapping[Verdict, float] = MappingProxyType({"found": 1.0, "weak match": 0.5, "not here": 0.0})
NO_HEAT = (FLOOR, 1.0)  # heat range of a slot that paints nothing, whose values are 0

Shown = Sequence[QueryResult | None]  # by slot; None where a slot has no answer


def painted(shown: Shown) -> list[int]:
    """Slots that paint anything."""
    return [slot for slot, result in enumerate(shown) if result is not None and STRENGTH[result.verdict] > 0]


def columns(shown: Shown, display: Display, count: int) -> Array | None:
    """(count, Q) float32 values per Gaussian and slot; a slot that paints nothing is zero. None where no slot
    paints anything."""
    slots = painted(shown)
    if not slots:
        return None
    values = np.zeros((count, len(shown)), np.float32)
    for slot in slots:
        result = shown[slot]
        assert result is not None
        of_members = display == "segmentation"
        values[:, slot] = result.members if of_members else result.relevancy[result.level]
    return values


def heat_ranges(shown: Shown, display: Display) -> HeatRanges:
    """Per slot, the values at which heat is 0 and 1. What is half as strong never gets hotter than a half."""
    slots = painted(shown)
    return tuple(
        NO_HEAT if result is None or slot not in slots else _range(result, display)
        for slot, result in enumerate(shown)
    )


def _range(result: QueryResult, display: Display) -> tuple[float, float]:
    low, high = (0.0, 1.0) if display == "segmentation" else result.heat_range
    return low, low + (high - low) / STRENGTH[result.verdict]


def fitted(picture: PictureConfig, shown: Shown) -> PictureConfig:
    """`picture`, with each query in its own colour as soon as two are painted."""
    return replace(picture, own_colours=len(painted(shown)) > 1)
