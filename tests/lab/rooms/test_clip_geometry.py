"""The simulated CLIP: its cosines are those that were asked for."""

import numpy as np
import pytest

from assets.making.truth import Region, Truth
from langsplat_core.errors import InputError
from langsplat_core.lab.rooms.clip_geometry import OTHER, PROMPTS, ClipGeometry, read_geometry
from langsplat_core.semantics.store import ImageFeatures

THINGS = [3 * letter for letter in "abcdefghijklmnopqrtuvwxyz"]
SIDE = 2  # px of a region


def room(tmp_path, name: str = "room") -> tuple[Truth, np.ndarray, ImageFeatures]:
    """One row of regions, each a thing; the truth, its ids, and masks that are exact."""
    folder = tmp_path / name / "photographs" / "truth"
    regions = {n: Region("whole", thing, thing, "", thing, (thing,)) for n, thing in enumerate(THINGS)}
    ids = np.full((3, SIDE, SIDE * len(THINGS)), -1)
    ids[2] = np.repeat(np.arange(len(THINGS)), SIDE)[None]
    blank = np.zeros((len(THINGS), 512), np.float32)
    return Truth(folder, (), regions), ids, ImageFeatures(ids.astype(np.int32), blank)


def seen(encoder: ClipGeometry, tmp_path, views: int = 12, name: str = "room") -> np.ndarray:
    """(V, R, D) vectors of every region in several views."""
    truth, ids, features = room(tmp_path, name)
    return np.stack([encoder.describe(features, ids, truth, view).vectors for view in range(views)])


@pytest.mark.parametrize(("own", "alike"), [(0.31, 0.65), (0.25, 0.65), (0.28, 0.5), (0.31, 0.8)])
def test_pictures_have_the_cosines_that_were_asked_for(tmp_path, own, alike):
    encoder = ClipGeometry(own, alike)
    texts = encoder.encode_texts(THINGS)
    vectors = seen(encoder, tmp_path)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=-1), 1, atol=1e-5)
    cosines = np.median(vectors @ texts.T, axis=0)  # over views: one mask in seven shows another region
    same = np.eye(len(THINGS), dtype=bool)
    assert cosines[same].mean() == pytest.approx(own, abs=0.025)
    assert cosines[~same].mean() == pytest.approx(OTHER, abs=0.02)
    pairs = vectors[0] @ vectors[1].T
    assert np.median(pairs[~same]) == pytest.approx(alike, abs=0.04)
    prompts = texts @ texts.T
    assert prompts[~same].mean() == pytest.approx(PROMPTS, abs=0.03)


def test_the_same_is_made_again_and_another_room_has_other_noise(tmp_path):
    encoder = ClipGeometry(0.31)
    once, again = seen(encoder, tmp_path, 2), seen(ClipGeometry(0.31), tmp_path, 2)
    np.testing.assert_array_equal(once, again)
    assert (once[0] != once[1]).any()
    other = seen(encoder, tmp_path, 2, "other")
    assert 0.9 > float((once[0] * other[0]).sum(1).mean()) > 0.5


def test_a_phrase_lies_by_its_head_and_by_what_is_said_of_it():
    encoder = ClipGeometry(0.31)
    red, mug, handle, of_mug = encoder.encode_texts(["red mug", "mug", "mug handle", "handle of the mug"])
    assert red @ mug > 0.85
    assert handle @ mug > 0.65
    assert of_mug @ handle > 0.95


def test_vectors_of_a_file_are_taken_by_name(tmp_path):
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(5, 512)) + 1
    np.save(tmp_path / "words_clip.npy", vectors)
    (tmp_path / "words_names.txt").write_text("mug\nwine_glass\nchair\ntable\ncap_(headwear)\n")
    encoder = ClipGeometry(0.31, vectors=tmp_path / "words_clip.npy")
    unit = vectors / np.linalg.norm(vectors, axis=1)[:, None]
    common = unit.mean(0) / np.linalg.norm(unit.mean(0))
    for row, name in ((0, "mug"), (0, "mugs"), (1, "wine glass"), (4, "cap")):
        own = unit[row] - (unit[row] @ common) * common
        assert encoder.direction(name) @ (own / np.linalg.norm(own)) == pytest.approx(1, abs=1e-6)
    assert encoder.digest != ClipGeometry(0.31).digest


@pytest.mark.parametrize("text", ["0.1", "0.5,0.9", "high", "", "0.31,0.99", "nan"])
def test_cosines_that_cannot_be_are_refused_in_one_line(text):
    with pytest.raises(InputError) as refused:
        read_geometry(f"clip-geometry:{text}")
    assert "\n" not in str(refused.value)


def test_other_names_are_no_geometry():
    assert read_geometry("demo") is None
    made = read_geometry("clip-geometry:0.28,0.5")
    assert made is not None
    assert (made.own, made.alike) == (0.28, 0.5)
