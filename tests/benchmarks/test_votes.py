"""The report of votes: which answers and masks its tables count."""

from types import SimpleNamespace

import numpy as np

from tests.benchmarks.votes import Explained, answer_table, measure_evidence, vote_table
from tests.support.fakes import NAMES, PER_BLOB, FakeEncoder, axis, blob_scene


def explained(right: bool, fits: tuple[float, ...], replaced: tuple[bool, ...], **figures) -> Explained:
    return Explained(1, "wrong", "mug", right, fits=fits, replaced=replaced, **figures)


ROWS = [
    explained(True, (2, 1, -1), (False, False, True), probability=0.8, share=0.7, fitting=0.6),
    explained(True, (1, 0.5), (False, False), probability=0.9, share=0.8, fitting=0.7),
    explained(False, (2, 0, -2), (False, True, False), probability=0.85, share=0.9, fitting=0.1),
]


def test_wrong_votes_are_told_by_their_fits():
    """2, 1, 2 and -2 are right, -1 and 0 are not: six of eight pairs lie the right way round."""
    assert "| wrong | 6 | 2 | 75.0 | 100.0 | 50.0 |" in vote_table(ROWS)
    assert "| wrong |" not in vote_table(ROWS[1:2])


def test_answers_are_told_by_each_figure():
    assert "| wrong | 3 | 2 | 50.0 | 0.0 | 100.0 |" in answer_table(ROWS)


def test_answers_are_compared_with_the_truth():
    """A mug that is there, a book that the truth calls a plant."""
    scene, mask = blob_scene(), np.zeros((3, 120, 160), np.int32)
    seen = SimpleNamespace(labels=mask, vectors=axis(0)[None])
    phrases = [SimpleNamespace(text=text, kind="object", ids=(n,)) for text, n in (("mug", 0), ("book", 2))]
    views = [(camera, seen) for camera in scene.cameras]
    room = SimpleNamespace(
        seed=7, gaussians=scene.gaussians, encoder=FakeEncoder(), views=lambda _: views,
        labels=np.tile(np.repeat([0, 1, 2], PER_BLOB), (3, 1)), field=lambda _: (scene.language, None, 0.0),
        truth=SimpleNamespace(phrases=phrases, absent=lambda _: list(NAMES[3:])),
    )  # fmt: skip
    mug, book = measure_evidence(room, "truth")
    assert (mug.text, mug.right, book.text, book.right) == ("mug", True, "book", False)
    assert mug.fits == mug.replaced == ()  # the mask is of everything
    assert mug.share < 0.5
