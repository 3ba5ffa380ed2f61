"""Which pictures the scene's area shows, and where. No window and no graphics device here.

A picture beside another is the state as it would be if that were the only one: a copy in which another
display is chosen. So whatever decides what a display shows holds for it too.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import Display
from langsplat_core.display.displays import DISPLAYS
from langsplat_core.query.answers import QueryResult
from langsplat_core.scene import LEVELS
from langsplat_viewer.drawing.seeing import Split
from langsplat_viewer.state import ViewerState

_AT_LEVEL: WeakKeyDictionary[QueryResult, tuple[QueryResult, ...]] = WeakKeyDictionary()


def pictures(state: ViewerState) -> tuple[ViewerState, ...]:
    """From left to right, the state that each picture shows; only `state` itself where nothing is split."""
    split = state.seeing.split
    if split.mode == "wipe":
        return state, _with_display(state, split.second, split.second_level)
    if split.mode == "levels":
        return tuple(_with_level(state, level) for level in range(len(LEVELS)))
    return (state,)


def columns(split: Split) -> int:
    """In how many columns the area is divided; the two pictures of a wipe lie over each other."""
    return len(LEVELS) if split.mode == "levels" else 1


def picture_size(state: ViewerState) -> tuple[int, int]:
    """Of one picture, pixels; all have the same."""
    width, height = state.size
    return max(width // columns(state.seeing.split), 1), height


def within_picture(split: Split, u: float) -> float:
    """A place across the area, as a fraction of its width -> the same as a fraction of the picture there."""
    count = columns(split)
    return u * count - min(max(int(u * count), 0), count - 1)


def joined(split: Split, images: Sequence[Array]) -> Array:
    """(H, W, C) pictures of `pictures` -> one, as the area shows them."""
    if split.mode == "wipe" and len(images) > 1:
        line = round(split.at * images[0].shape[1])
        return np.concatenate([images[0][:, :line], images[1][:, line:]], 1)
    return np.concatenate(list(images), 1)


def labels(state: ViewerState) -> tuple[str, ...]:
    """What to write over each picture."""
    return tuple(_label(picture) for picture in pictures(state))


def _label(picture: ViewerState) -> str:
    row = DISPLAYS[picture.picture.display]
    by_level = row.extra == "latent" or picture.seeing.split.mode == "levels"
    return f"{row.label}, {LEVELS[picture.latent_level]}" if by_level else row.label


def _with_display(state: ViewerState, display: Display, latent_level: int) -> ViewerState:
    shown = copy(state)
    shown.picture, shown.latent_level = replace(state.picture, display=display), latent_level
    return shown


def _with_level(state: ViewerState, level: int) -> ViewerState:
    asks = DISPLAYS[state.picture.display].needs_query
    shown = _with_display(state, "relevancy" if asks else "latent", level)
    if asks:
        shown.queries = [
            query if query.result is None else replace(query, result=at_level(query.result, level))
            for query in state.queries
        ]
    return shown


def at_level(result: QueryResult, level: int) -> QueryResult:
    """The same answer as if it were for another level; the same object whenever it is asked for. Its heat
    range stays, so that the same colour means the same relevancy at all levels."""
    if result not in _AT_LEVEL:
        _AT_LEVEL[result] = tuple(replace(result, level=index) for index in range(len(LEVELS)))
    return _AT_LEVEL[result][level]
