"""The answer to several phrases at once, as one selection."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Literal

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.selection import difference, intersection, union

Combination = Literal["union", "intersection", "difference"]
_SELECT = {"union": union, "intersection": intersection, "difference": difference}


@dataclass(frozen=True, eq=False)
class Combined:
    """What several answers make together."""

    members: Array  # (N,) bool
    relevancy: Array  # (N,) in [0, 1]: the largest of a union, the least of an intersection, else the first's


def combine(results: Sequence[QueryResult], how: Combination) -> Combined:
    """One or more answers in one. Raises InputError where a phrase was not found, or nothing is left."""
    for result in results:
        if not result.found or not result.members.any():
            raise InputError(
                f"'{result.phrase}' was not found (score {result.peak:.3f}): nothing to select; ask in other "
                "words, or at another --level"
            )
    members = _SELECT[how]([result.members for result in results])
    if not members.any():
        phrases = ", ".join(f"'{result.phrase}'" for result in results)
        raise InputError(f"the {how} of {phrases} is empty: nothing to select; try another --combine")
    values = [result.relevancy[result.level] for result in results]
    if how == "union":
        return Combined(members, reduce(np.maximum, values))
    return Combined(members, reduce(np.minimum, values) if how == "intersection" else values[0])
