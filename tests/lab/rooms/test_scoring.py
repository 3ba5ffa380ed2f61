"""Scores in closed form, cuts, and maps of many phrases at once."""

from types import SimpleNamespace

import numpy as np
import pytest

from assets.making.truth import Phrase, Region, Truth
from langsplat_core.arrays import unit
from langsplat_core.lab.rooms import scoring as synthetic
from langsplat_core.lab.rooms.report import separation
from langsplat_core.lab.rooms.scoring import (
    Answer,
    Asked,
    ask,
    evaluate_direct,
    found_rate,
    relevancy_maps,
)
from langsplat_core.query.answers import CUT_RULES, cut_level
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.lookup import decoded_relevancy, splatted_relevancy
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.scene import CANONICAL_PHRASES, LanguageField, Scene
from langsplat_core.semantics.relevancy import latent_relevancy
from tests.support.scenes import random_camera, random_gaussians
from tests.support.two_blobs import random_codec, two_blob_scene


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


@pytest.mark.parametrize(
    ("rule", "expected"),
    [
        ("floor", 0.7),
        ("median", 0.6),
        ("range", 0.1 + 0.7 * 0.8),
    ],
)
def test_cuts(rule, expected):
    values = np.array([[0.1, 0.3], [0.3, 0.9]])
    assert cut_level(rule, values, peak=0.9, median=0.3) == pytest.approx(expected)


@pytest.mark.parametrize("rule", CUT_RULES)
def test_a_cut_never_lets_a_flat_map_through(rule):
    assert not (np.full((4, 4), 0.5) > cut_level(rule, np.full((4, 4), 0.5), 0.5, 0.5)).any()


def test_separation_is_the_chance_of_the_right_order():
    assert separation(np.array([0.9, 0.5]), np.array([0.5, 0.1, 0.6])) == pytest.approx(4.5 / 6)
    assert separation(np.array([0.9]), np.zeros(0)) == 1.0


def test_absent_things_have_no_other_name_in_the_room():
    truth = Truth(None, (), {0: Region("whole", "", "", words=("mug", "cup", "orange", "couch"))})
    assert truth.absent(["mug", "orange", "sofa", "lamp", "apple"]) == ["apple", "lamp"]


def test_unknown_phrases_are_named_not_asked():
    scene, *_ = two_blob_scene()
    rows = {text: 8 + row for row, text in enumerate(CANONICAL_PHRASES)}  # as the scene has them
    axes = SimpleNamespace(
        encode_texts=lambda texts: np.eye(16, dtype=np.float32)[[rows.get(text, 0) for text in texts]],
        unknown_words=lambda text: tuple(word for word in text.split() if word == "cactus"),
    )
    asked = ask(QueryEngine(scene, lambda _: axes), ["mug", "red cactus", "mug"])
    assert asked.unknown == ("red cactus",)
    assert found_rate(asked, ["mug", "red cactus"]) == (1.0, 1)


@pytest.fixture(scope="module")
def random_scene() -> Scene:
    """400 Gaussians with random latents of a random autoencoder."""
    rng = np.random.default_rng(3)
    gaussians = random_gaussians(400, 3)
    latents = unit(rng.normal(size=(3, 400, 3))).astype(np.float32)
    canonical = unit(rng.normal(size=(4, 16))).astype(np.float32)
    field = LanguageField(latents, np.ones((3, 400), np.float32), random_codec(rng), canonical, "x")
    return Scene(gaussians, field)


@pytest.mark.parametrize("paper_order", [True, False])
def test_maps_of_all_phrases_together_equal_those_one_by_one(random_scene, monkeypatch, paper_order):
    rng = np.random.default_rng(4)
    engine = QueryEngine(random_scene)
    view = CpuRasterizer().view(random_scene.gaussians, random_camera(1))
    vectors = unit(rng.normal(size=(5, 16))).astype(np.float32)
    levels = (2, 0, 2, 2, 0)
    answers = [
        answer(engine.relevancy(v)[level], level=level, vector=v)
        for v, level in zip(vectors, levels, strict=True)
    ]
    decoded = []

    def counting(*arguments):
        decoded.append(arguments[2])
        return decoded_relevancy(*arguments)

    monkeypatch.setattr(synthetic, "decoded_relevancy", counting)
    maps = list(relevancy_maps(engine, view, answers, paper_order))
    assert sorted(decoded) == ([0, 2] if paper_order else [])
    for got, one in zip(maps, answers, strict=True):
        if paper_order:
            want = decoded_relevancy(view, engine.field, one.level, one.vector[None], 0.3)[..., 0]
        else:
            want = splatted_relevancy(view, one.values[:, None], 0.3)[..., 0]
        # float32 products of other sizes round differently; relevancy magnifies a cosine by at most 2.5
        np.testing.assert_allclose(got, want, atol=1e-5)


def test_an_exact_engine_decodes_every_gaussian(random_scene):
    vector = unit(np.random.default_rng(5).normal(size=16)).astype(np.float32)
    field = random_scene.language
    want = latent_relevancy(field.codec, field.latents.reshape(-1, 3), vector[None], field.canonical)
    exact = QueryEngine(random_scene, exact=True).relevancy(vector)
    np.testing.assert_allclose(exact, want.reshape(3, 400), atol=1e-6)
    assert np.abs(QueryEngine(random_scene).relevancy(vector) - exact).max() > 1e-6
