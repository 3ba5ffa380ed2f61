"""What is selected, hidden and deleted in the scene of three blobs, in short."""

import numpy as np

from langsplat_viewer.marks import Marks
from langsplat_viewer.viewer import Viewer
from tests.support.fakes import PER_BLOB, WORDS

STRAYS = 0.06  # of a blob, in a picture: what is nearer to the eye is farther from the middle


def blob(word: str) -> np.ndarray:
    """(360,) bool: the Gaussians of one blob."""
    return np.repeat([word == other for other in WORDS], PER_BLOB)


def marks_of(viewer: Viewer) -> Marks:
    return viewer.state.selection.marks


def names(rows: np.ndarray) -> str:
    """The blobs of which `rows` hold all but strays; "?" beside them where one is there in part."""
    shares = rows.reshape(len(WORDS), PER_BLOB).mean(1)
    whole = [word for word, share in zip(WORDS, shares, strict=True) if share >= 1 - STRAYS]
    partly = ["?"] if ((shares > STRAYS) & (shares < 1 - STRAYS)).any() else []
    return " ".join(whole + partly)


def marked(viewer: Viewer) -> tuple[str, str, str]:
    """Selected, hidden, deleted."""
    marks = marks_of(viewer)
    return names(marks.selected), names(marks.hidden), names(marks.deleted)
