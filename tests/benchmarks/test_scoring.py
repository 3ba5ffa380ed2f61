"""Scores in closed form, oracles, and the simulated CLIP that methods are compared with."""

from types import SimpleNamespace

import numpy as np
import pytest

from assets.making.truth import Phrase, Region, Truth
from langsplat_core.arrays import unit
from langsplat_core.errors import InputError
from langsplat_core.query.engine import QueryEngine
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.semantics.features import ImageFeatures
from tests.benchmarks.oracles import (
    OTHER,
    PROMPTS,
    ClipGeometry,
    oracle_vectors,
    phrase_vectors,
    read_geometry,
    true_labels,
)
from tests.benchmarks.scoring import Asked, ask, evaluate_direct, found_rate
from tests.support.fakes import PER_BLOB, FakeEncoder, blob_scene, blobs, cameras

THINGS = [3 * letter for letter in "abcdefghijklmnopqrtuvwxyz"]
SIDE = 2  # px of a region


def test_direct_overlap_has_its_closed_form():
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
    made = SimpleNamespace(members=inside)
    truth = Truth(None, phrases)
    engine = SimpleNamespace(regions=SimpleNamespace(everywhere=labels))
    asked = Asked(engine, {phrase.text: made for phrase in phrases}, (), 0.0)
    (score,) = evaluate_direct(asked, labels, truth)
    assert score.ceiling == 1
    assert (score.kind, score.phrases) == ("object", 2)
    assert score.mean_iou == pytest.approx((30 / 100 + 70 / 120) / 2)


def test_absent_things_have_no_synonym_in_the_room():
    truth = Truth(None, (), {0: Region("whole", "", "", words=("mug", "cup", "orange", "couch"))})
    assert truth.absent(["mug", "orange", "sofa", "lamp", "apple"]) == ["apple", "lamp"]


def test_phrases_with_unknown_words_are_not_asked():
    asked = ask(QueryEngine(blob_scene(), lambda _: FakeEncoder()), ["mug", "red cactus", "mug"])
    assert asked.unknown == ("red cactus",)
    assert found_rate(asked, ["mug", "red cactus"]) == (1.0, 1)


def test_oracle_gives_regions_the_vectors_of_their_words():
    names, encoder = {0: "mug", 1: "book", 2: "cactus", 3: ""}, FakeEncoder()
    regions = {key: Region("whole", "", "", phrase=phrase) for key, phrase in names.items()}
    vectors = phrase_vectors(Truth(None, (), regions), encoder)
    assert set(vectors) == {0, 1}
    ids = np.full((3, 4, 5), 0)
    ids[1, :, :3], ids[1, :, 3:] = 1, 2
    ids[2, 0] = -1
    labels = np.full((3, 4, 5), -1, np.int32)
    labels[0], labels[1, :, :4], labels[1, :, 4:], labels[2] = 0, 1, 2, 3
    own = unit(np.random.default_rng(0).normal(size=(4, encoder.vector("mug").size))).astype(np.float32)
    told = oracle_vectors(ImageFeatures(labels, own), ids, vectors)
    want = encoder.encode_texts(["mug", "book"])
    np.testing.assert_array_equal(told.vectors, [want[0], want[1], own[2], want[0]])
    np.testing.assert_array_equal(told.labels, labels)


def test_true_label_is_what_a_gaussian_shows_most():
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
def test_simulated_clip_has_the_requested_cosines(tmp_path, own, alike):
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


def test_simulated_clip_draws_noise_by_room(tmp_path):
    encoder = ClipGeometry(0.31)
    once, again = seen(encoder, tmp_path, 2), seen(ClipGeometry(0.31), tmp_path, 2)
    np.testing.assert_array_equal(once, again)
    assert (once[0] != once[1]).any()
    other = seen(encoder, tmp_path, 2, "other")
    assert 0.9 > float((once[0] * other[0]).sum(1).mean()) > 0.5


def test_phrase_vector_follows_head_and_modifier():
    encoder = ClipGeometry(0.31)
    red, mug, handle, of_mug = encoder.encode_texts(["red mug", "mug", "mug handle", "handle of the mug"])
    assert red @ mug > 0.85
    assert handle @ mug > 0.65
    assert of_mug @ handle > 0.95


def test_vectors_of_a_file_are_found_by_name(tmp_path):
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
def test_impossible_cosines_are_refused_in_one_line(text):
    with pytest.raises(InputError) as refused:
        read_geometry(f"clip-geometry:{text}")
    assert "\n" not in str(refused.value)
    assert read_geometry("demo") is None  # no such encoder, and no mistake
