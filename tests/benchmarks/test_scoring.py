"""Scores in closed form, oracles, and the simulated CLIP and patches that methods are compared with."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from assets.making.truth import Phrase, Region, Truth
from langsplat_core.arrays import unit
from langsplat_core.errors import InputError
from langsplat_core.progress import silent
from langsplat_core.query.engine import QueryEngine
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.semantics.masks import label_maps
from langsplat_core.semantics.relevancy import relevancy
from langsplat_core.semantics.store import ImageFeatures
from tests.benchmarks.lifting import PatchField, among_gaussians, patch_vectors, pictures
from tests.benchmarks.oracles import (
    OTHER,
    PROMPTS,
    SIDES,
    ClipGeometry,
    TileMasks,
    oracle_vectors,
    phrase_vectors,
    read_geometry,
    true_labels,
)
from tests.benchmarks.scoring import Answer, Asked, ask, cut_level, evaluate_direct, found_rate
from tests.support.fakes import PER_BLOB, FakeEncoder, blob_scene, blobs, cameras
from tests.support.scenes import random_camera, random_gaussians

THINGS = [3 * letter for letter in "abcdefghijklmnopqrtuvwxyz"]
SIDE = 2  # px of a region


def answer(values, peak=1.0, level=2, vector=None, members=None) -> Answer:
    values = np.asarray(values, np.float32)
    return Answer(
        vector=np.zeros(4) if vector is None else vector,
        level=level,
        values=values,
        members=values > 0.5 if members is None else members,
        even=values,
        peak=peak,
        median=float(np.median(values)),
        found=True,
    )


@pytest.mark.parametrize("rule", ["regions", "floor"])
def test_direct_overlap_has_its_closed_form(rule):
    """What answers is cut from the values, or what the answer itself says."""
    labels = np.full((3, 200), -1)
    labels[2, :180] = np.repeat([0, 1, 2], 60)  # the last 20 are shown nowhere
    inside = np.zeros(200, bool)
    inside[30:100] = True  # 30 of thing 0, 40 of thing 1
    inside[180:] = True
    phrases = (
        Phrase("mug", "object", (0,)),
        Phrase("mug or bowl", "object", (0, 1)),
        Phrase("rare", "part", (5,)),
    )
    made = answer(0.9 * inside) if rule == "floor" else answer(np.full(200, 0.9), members=inside)
    truth = Truth(None, phrases)
    engine = SimpleNamespace(regions=SimpleNamespace(everywhere=labels))
    asked = Asked(engine, {phrase.text: made for phrase in phrases}, (), 0.0)
    (score,) = evaluate_direct(asked, labels, truth, rule)
    assert score.ceiling == (1 if rule == "regions" else 0)
    assert (score.kind, score.phrases) == ("object", 2)
    assert score.mean_iou == pytest.approx((30 / 100 + 70 / 120) / 2)


@pytest.mark.parametrize(("rule", "expected"), [("floor", 0.7), ("median", 0.6), ("range", 0.1 + 0.7 * 0.8)])
def test_cuts_which_let_no_flat_map_through(rule, expected):
    values = np.array([[0.1, 0.3], [0.3, 0.9]])
    assert cut_level(rule, values, peak=0.9, median=0.3) == pytest.approx(expected)
    assert not (np.full((4, 4), 0.5) > cut_level(rule, np.full((4, 4), 0.5), 0.5, 0.5)).any()


def test_absent_things_have_no_other_name_in_the_room():
    truth = Truth(None, (), {0: Region("whole", "", "", words=("mug", "cup", "orange", "couch"))})
    assert truth.absent(["mug", "orange", "sofa", "lamp", "apple"]) == ["apple", "lamp"]


def test_unknown_phrases_are_named_not_asked():
    asked = ask(QueryEngine(blob_scene(), lambda _: FakeEncoder()), ["mug", "red cactus", "mug"])
    assert asked.unknown == ("red cactus",)
    assert found_rate(asked, ["mug", "red cactus"]) == (1.0, 1)


class Speller:
    """A text encoder that gives every phrase its own axis and does not know cactuses."""

    def __init__(self) -> None:
        self.known: dict[str, int] = {}

    def encode_texts(self, texts):
        return np.stack(
            [np.eye(512, dtype=np.float32)[self.known.setdefault(t, len(self.known))] for t in texts]
        )

    def unknown_words(self, text):
        return tuple(word for word in text.split() if word == "cactus")

    def near_words(self, word):
        return ()


def test_perfect_embeddings_are_text_vectors_of_the_true_words():
    names = {0: "red mug", 1: "handle of the red mug", 2: "blue cactus", 3: ""}
    encoder = Speller()
    regions = {key: Region("whole", "", "", phrase=phrase) for key, phrase in names.items()}
    vectors = phrase_vectors(Truth(None, (), regions), encoder)
    assert set(vectors) == {0, 1}
    ids = np.full((3, 4, 5), 0)
    ids[1, :, :3], ids[1, :, 3:] = 1, 2
    ids[2, 0] = -1
    labels = np.full((3, 4, 5), -1, np.int32)
    labels[0], labels[1, :, :4], labels[1, :, 4:], labels[2] = 0, 1, 2, 3
    own = unit(np.random.default_rng(0).normal(size=(4, 512))).astype(np.float32)
    told = oracle_vectors(ImageFeatures(labels, own), ids, vectors)
    want = [encoder.encode_texts([text])[0] for text in ("red mug", "handle of the red mug")]
    np.testing.assert_array_equal(told.vectors, [want[0], want[1], own[2], want[0]])
    np.testing.assert_array_equal(told.labels, labels)


def test_a_gaussian_is_what_it_shows_most_of():
    count, gaussians = PER_BLOB, blobs().take(np.arange(3 * PER_BLOB) // PER_BLOB != 1)  # left and right
    gaussians.opacity_logits[:] = -1  # so that none is hidden
    camera = cameras()[1].resized(64, 48)
    alpha = CpuRasterizer().view(gaussians, camera).splat(np.ones((2 * count, 1), np.float32))[1]
    ids = np.full((3, 48, 64), -1)
    columns = np.arange(64)[None].repeat(48, 0)
    ids[2] = np.where(alpha > 0, np.where(columns < camera.cx, 7, 9), -1)
    got = true_labels(CpuRasterizer(), gaussians, [(camera, ids)] * 2)
    assert (got[2][:count] == 7).all()
    assert (got[2][count:] == 9).all()
    assert (got[:2] == -1).all()


def row_of_things(tmp_path, name: str = "room") -> tuple[Truth, np.ndarray, ImageFeatures]:
    """One row of regions, each a thing; the truth, its ids, and masks that are exact."""
    folder = tmp_path / name / "photographs" / "truth"
    regions = {n: Region("whole", thing, thing, "", thing, (thing,)) for n, thing in enumerate(THINGS)}
    ids = np.full((3, SIDE, SIDE * len(THINGS)), -1)
    ids[2] = np.repeat(np.arange(len(THINGS)), SIDE)[None]
    blank = np.zeros((len(THINGS), 512), np.float32)
    return Truth(folder, (), regions), ids, ImageFeatures(ids.astype(np.int32), blank)


def seen(encoder: ClipGeometry, tmp_path, views: int = 12, name: str = "room") -> np.ndarray:
    """(V, R, D) vectors of every region in several views."""
    truth, ids, features = row_of_things(tmp_path, name)
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
    assert read_geometry("demo") is None  # no such encoder, and no mistake


class MeanColour:
    """An encoder whose vector is the mean colour of a picture."""

    id, image_size = "colour", 8

    def encode_images(self, crops):
        return unit(np.asarray(crops, np.float64).mean(axis=(1, 2)) + 1).astype(np.float32)


def two_halves(height: int = 60, width: int = 80):
    image = np.zeros((height, width, 3), np.uint8)
    image[:, : width // 2, 0] = 255
    image[:, width // 2 :, 2] = 255
    return image


@pytest.mark.parametrize("scale", [0.05, 0.3, 1.0, 3.0])
def test_patches_say_what_is_near(scale):
    vectors = patch_vectors(two_halves(), MeanColour(), scale)
    assert vectors.shape == (60, 80, 3)
    assert vectors.dtype == np.float32
    if scale < 1:  # far from the border between the halves the patches hold one colour
        np.testing.assert_allclose(
            vectors[:, 2], unit(np.array([256.0, 1, 1]))[None].repeat(60, 0), atol=1e-4
        )
        np.testing.assert_allclose(
            vectors[:, -2], unit(np.array([1, 1, 256.0]))[None].repeat(60, 0), atol=1e-4
        )
        middle = vectors[30, :, 0]
        assert (np.diff(middle) <= 1e-6).all()  # interpolated in between, not torn


def test_the_best_scale_is_the_one_with_the_highest_peak():
    rng = np.random.default_rng(0)
    vectors = unit(rng.normal(size=(3, 50, 6))).astype(np.float32)
    vectors[1, 7] = 0
    canonical = unit(rng.normal(size=(2, 6))).astype(np.float32)
    field = PatchField(vectors, canonical, 10.0)
    phrase = vectors[1, 9]
    found = among_gaussians(field, phrase[None])[0]
    want = relevancy(vectors[1], phrase[None], canonical)[:, 0]
    want[7] = 0
    np.testing.assert_allclose(found, want, atol=1e-6)
    gaussians, camera = random_gaussians(50), random_camera(width=32, height=24)
    view = CpuRasterizer().view(gaussians, camera)
    single = [pictures(replace(field, vectors=vectors[[scale]]), view, phrase[None])[0] for scale in range(3)]
    best = max(single, key=lambda shown: shown.max())
    np.testing.assert_array_equal(pictures(field, view, phrase[None])[0], best)


@pytest.mark.parametrize("size", [(48, 64), (50, 33), (1, 1)])
def test_tiles_cover_the_picture_once(size):
    levels = TileMasks()(np.zeros((*size, 3), np.uint8), silent)
    for masks, share in zip(levels.masks, SIDES, strict=True):
        assert (masks.sum(axis=0) == 1).all()
        assert masks.any(axis=(1, 2)).all()
        assert max(mask.any(axis=0).sum() for mask in masks) <= max(round(share * size[0]), 1)
    assert (label_maps(levels) >= 0).all()
