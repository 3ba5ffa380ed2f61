"""Words for Gaussians, for a pixel, for a scene."""

import time
from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.arrays import Array, unit
from langsplat_core.query import describe
from langsplat_core.query.describe import Describer, build_words, field_features, look_at_pixel
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.inventory import (
    DEEPEST,
    completions,
    corrected,
    scene_inventory,
    scene_outline,
    suggest,
    synonym_groups,
)
from langsplat_core.raster import load_lifting_rasterizer
from langsplat_core.scene import NO_NODE, LanguageField, LinearCodec, Scene, Tree
from langsplat_core.scene.codec import CodebookCodec
from langsplat_core.scene.surface import surface_areas
from langsplat_core.semantics.encoders import DEMO
from tests.support.fakes import (
    CENTRES,
    NAMES,
    PER_BLOB,
    WORDS,
    FakeEncoder,
    axis,
    blob_scene,
    language,
    named_field,
    named_scene,
)
from tests.support.scenes import unturned_gaussians


def describer(scene: Scene, vocabulary=NAMES) -> Describer:
    return Describer(QueryEngine(scene, lambda _: FakeEncoder()), vocabulary)


@pytest.mark.parametrize("codebook", [True, False])
def test_every_blob_is_its_word(codebook):
    asked = describer(named_scene(codebook))
    for number, word in enumerate(WORDS):
        rows = np.arange(number * PER_BLOB, (number + 1) * PER_BLOB)
        subpart, part, whole = asked.at_gaussians(rows)
        assert (subpart.words, subpart.known) == ((), 0)
        assert (whole.words[0].phrase, whole.known) == (word, 1)
        assert whole.words[0].probability > 0.95
        assert sum(found.probability for found in whole.words) + whole.other == pytest.approx(1)
        if not codebook:  # at "part" all mean 0.8 of a canonical phrase and 0.6 of "plant"
            assert part.words[0].phrase == "plant"
            assert part.other > part.words[0].probability


def test_boolean_rows_and_weights_are_accepted():
    asked = describer(named_scene())
    mask = np.zeros(3 * PER_BLOB, bool)
    mask[[0, PER_BLOB]] = True
    two = asked.at_gaussians(mask, np.array([3.0, 1.0]), top=2)[2]
    assert two == asked.at_gaussians(np.array([0, PER_BLOB]), np.array([3.0, 1.0]), top=2)[2]
    assert [word.phrase for word in two.words] == ["mug", "book"]
    np.testing.assert_allclose([word.probability for word in two.words], [0.75, 0.25], atol=0.01)


@pytest.mark.parametrize("codebook", [True, False])
def test_pixel_words_follow_the_rows_of_w(codebook):
    """Against float64: the reference's weights at the pixel, every Gaussian's words; the median of depths."""
    scene = named_scene(codebook)
    asked, camera = describer(scene), scene.cameras[1]
    engine, names = asked.engine, asked.words[2]
    results = [engine.run(word) for word in WORDS]
    relevancy = np.stack([result.relevancy[result.level] for result in results], 1)
    own = names.probabilities(engine.field.latents[2]).astype(np.float64)
    view = load_lifting_rasterizer("reference").view(scene.gaussians, camera)
    depths = camera.project(scene.gaussians.means.astype(np.float64))[1]
    for thing, centre in enumerate([*CENTRES, (CENTRES[0] + CENTRES[1]) / 2 + (-0.15, 0, 0)]):
        column, row = camera.project(centre[None])[0][0].astype(int).tolist()
        image = np.zeros((camera.height, camera.width, 1))
        image[row, column] = 1
        weights = view.gather(image)[:, 0]
        if weights.sum() <= 0.3:
            continue
        found = look_at_pixel(asked, camera, (column, row), results, top=4)
        want = weights @ own / weights.sum()
        for word in found.words[2].words:
            assert word.probability == pytest.approx(want[names.phrases.index(word.phrase)], abs=1e-4)
        np.testing.assert_allclose(found.relevancy, weights @ relevancy / weights.sum(), atol=2e-4)
        back, depth = camera.project(found.position[None])
        np.testing.assert_allclose(back[0], (column + 0.5, row + 0.5), atol=1e-6)
        assert found.depth == pytest.approx(depth[0])
        if thing < len(WORDS):
            assert found.words[2].words[0].phrase == WORDS[thing]
            assert np.linalg.norm(found.position - centre) < 0.6  # on the blob, towards the eye
        in_front = weights[depths < found.depth - 1e-9].sum()
        there = weights[np.abs(depths - found.depth) < 1e-6].sum()
        assert in_front - 1e-4 < weights.sum() / 2 <= in_front + there + 1e-4
    assert look_at_pixel(asked, camera, (0, 0)) is None


@pytest.mark.parametrize(("nodes", "step"), [(3000, 1), pytest.param(2**21, 5000, marks=pytest.mark.long)])
@pytest.mark.parametrize("wide", [False, True])
def test_trees_of_any_depth_have_an_outline(nodes, step, wide):
    scene = named_scene()
    scene.gaussians.means[0] = np.nan  # it is nowhere
    parents = np.full(nodes, nodes - 1, np.int32) if wide else np.arange(1, nodes + 1, dtype=np.int32)
    parents[-1] = NO_NODE
    leaves = (np.arange(len(scene.gaussians)) * step % nodes).astype(np.int32)
    tree = Tree(leaves, parents, np.full(nodes, 2, np.uint8), np.ones((nodes, 2), np.uint16))
    made = describer(replace(scene, language=replace(scene.language, tree=tree)))
    began = time.process_time()
    (outline,) = scene_outline(made)
    assert made.engine.run("mug").found
    assert time.process_time() - began < 30
    assert outline.count == len(scene.gaussians) - 1
    depth, row = 0, outline
    while row.parts:
        depth, row = depth + 1, row.parts[0]
    assert depth <= DEEPEST


def test_synonyms_share_an_entry_and_places_are_spots():
    field = named_field()
    codes = field.latents.copy()
    codes[2, 2 * PER_BLOB :] = codes[2, 0]  # the third blob is another mug
    book = {**field.phrasebook, "cup": axis(0), "beaker": axis(0)}
    scene = replace(named_scene(), language=replace(field, latents=codes, phrasebook=book))
    entries = scene_inventory(describer(scene, (*NAMES, "cup", "beaker")))
    (mug,) = [entry for entry in entries if "mug" in (entry.phrase, *entry.also)]
    assert {mug.phrase, *mug.also} == {"mug", "cup", "beaker"}
    assert mug.probability > 0.95  # of all three together
    assert sorted(float(spot.centre[0]) for spot in mug.spots) == pytest.approx([-1.2, 1.2], abs=0.1)
    # The best word of a foreign list may still be wrong: the canonical phrases are nearer.
    assert scene_inventory(describer(named_scene(), ("wall",))) == []
    # In a list of one word, it is the best of every feature, but likely of a mug's alone.
    assert [entry.phrase for entry in scene_inventory(describer(named_scene(), ("mug",)))] == ["mug"]


def test_bundled_parts_are_not_offered_for_wholes(monkeypatch):
    lists = {"things": ("mug", "book"), "parts": ("plant", "handle")}
    monkeypatch.setattr(describe, "bundled_vocabulary", lists.__getitem__)
    asked = describer(named_scene(), None)
    assert asked.words[2].phrases == ("mug", "book")
    assert asked.words[0].phrases == asked.words[1].phrases == ("mug", "book", "plant")
    assert asked.left_out == ("handle",)


def test_words_that_claim_the_same_are_grouped():
    surface = np.array([2.0, 1.0, 1.0, 4.0])
    mug = np.array([0.5, 0.5, 0, 0])
    cup = np.array([0.45, 0.4, 0.1, 0])
    vague = np.array([0.05, 0.1, 0.9, 0.4])  # everywhere a little: a name for neither
    assert synonym_groups(np.stack([vague, mug, cup], 1), surface) == [[0], [1, 2]]
    assert synonym_groups(np.zeros((0, 0)), np.zeros(0)) == []


def test_surface_of_gaussians():
    gaussians = unturned_gaussians(named_scene().gaussians.means, np.log([0.3, 0.02, 0.1]), 0.0)
    gaussians.means[0] = np.nan
    gaussians.log_scales[1] = np.log(50.0)  # a veil
    areas = surface_areas(gaussians)
    np.testing.assert_allclose(areas[1:], 0.5 * 0.3 * 0.1, rtol=1e-5)
    assert areas[0] == 0
    assert len(surface_areas(gaussians.take(np.zeros(0, int)))) == 0


# Words of field_features, against a plain float64 reference.

D, K, N, V = 24, 40, 90, 17


def field(kind: str) -> LanguageField:
    """Random field_features, by a codebook or by a linear codec; every seventh Gaussian has none."""
    rng = np.random.default_rng(4)
    confidence = np.ones((3, N), np.float32)
    confidence[:, ::7] = 0
    canonical = unit(rng.normal(size=(4, D))).astype(np.float32)
    if kind == "codebook":
        codec = CodebookCodec(unit(rng.normal(size=(K, D))).astype(np.float32), np.zeros((K, 3), np.float32))
        latents = rng.integers(0, K, (3, N, 1)).astype(np.uint16)
    else:
        codec = LinearCodec(np.linalg.qr(rng.normal(size=(D, 6)))[0].T.astype(np.float32).copy())
        latents = rng.normal(size=(3, N, 6)).astype(np.float32)
    return LanguageField(latents, confidence, codec, canonical, "none")


def phrases() -> tuple[tuple[str, ...], Array]:
    vectors = unit(np.random.default_rng(5).normal(size=(V, D))).astype(np.float32)
    return tuple(f"word {number}" for number in range(V)), vectors


def plain_probabilities(made: LanguageField, vectors: Array, latents: Array, bank: Array) -> Array:
    """The formula of the module, one meaning and one word after the other, in float64."""
    every = [vector.astype(np.float64) for vector in (*vectors, *made.canonical)]
    hub = [np.sort(bank.astype(np.float64) @ word)[-describe.NEAREST :].mean() for word in every]
    spreads = [np.std([float(word @ meaning) for word in every[: len(vectors)]]) for meaning in bank]
    rows, scale = [], describe.WORD_SCALE / np.median(spreads)
    for vector in made.codec.decode(latents).astype(np.float64):
        fits = np.array([scale * (vector @ word - own / 2) for word, own in zip(every, hub, strict=True)])
        shares = np.exp(fits - fits.max())
        rows.append(shares / shares.sum())
    return np.array(rows)


@pytest.mark.parametrize("kind", ["codebook", "linear"])
def test_probabilities_and_mixtures_are_those_of_the_formula(kind):
    made = field(kind)
    names, vectors = phrases()
    words = build_words(made, names, vectors)
    latents = made.latents[made.known][:60]
    want = plain_probabilities(made, vectors, latents, field_features(made))
    np.testing.assert_allclose(words.probabilities(latents), want, atol=2e-5)
    weights = np.random.default_rng(6).uniform(size=len(latents))
    mixture = words.mixture(latents, weights)
    np.testing.assert_allclose(mixture, weights @ want / weights.sum(), atol=2e-5)
    best, shares = words.best(latents, 3)
    order = np.argsort(-want[:, :V], axis=1)[:, :3]
    assert (best == order).mean() > 0.99  # equal but for rounding
    np.testing.assert_allclose(shares, np.take_along_axis(want, order, 1), atol=2e-5)


def test_hub_word_does_not_answer_everywhere():
    """Forty things around a common direction: "hub" is closest to most of them by the plain cosine."""
    rng = np.random.default_rng(0)
    centre = unit(np.ones(64))
    things = unit(centre + 0.7 * unit(rng.normal(size=(40, 64)))).astype(np.float32)
    names = unit(things + 0.85 * unit(rng.normal(size=(40, 64)))).astype(np.float32)
    codec = CodebookCodec(things, np.zeros((40, 3), np.float32))
    codes = np.tile(np.arange(40, dtype=np.uint16)[:, None], (3, 1, 1))
    far = np.tile(unit(rng.normal(size=64)).astype(np.float32), (4, 1))
    made = LanguageField(codes, np.ones((3, 40), np.float32), codec, far, "none")
    vectors = np.concatenate([names, centre[None].astype(np.float32)])
    labels = (*(f"thing {number}" for number in range(40)), "hub")
    words = build_words(made, labels, vectors)
    plain, right = (
        (scores.best(codes[0], 1)[0][:, 0] == np.arange(40)).mean()
        for scores in (replace(words, hubs=np.zeros_like(words.hubs)), words)
    )
    assert plain < 0.2 < 0.8 < right


# Examples of what a scene answers, and completions of what is typed.

PHRASES = ("teddy bear", "tea pot", "red mug", "teapot", "mug")


def test_every_example_is_found_in_the_scene():
    engine = QueryEngine(blob_scene(), lambda _: FakeEncoder())
    found = suggest(engine)
    assert {"mug", "book", "plant"} >= set(found.examples) > set()
    assert all(engine.run(phrase).found for phrase in found.examples)
    assert set(found.examples) <= set(found.phrases)
    assert len(suggest(engine, at_most=1).examples) == 1


def test_without_an_encoder_the_phrasebook_is_asked():
    nothing = (-axis(0) - axis(1) - axis(2)) / np.float32(np.sqrt(3))
    book = {"mug": axis(0), "unicorn": nothing, "of": axis(1), "red": axis(2)}
    fields = (replace(language(), phrasebook=book, encoder_id=one) for one in ("lab/clip", DEMO))
    found, guesses = (suggest(QueryEngine(replace(blob_scene(), language=field))) for field in fields)
    assert (found.examples, found.phrases) == (("mug", "red"), tuple(book))
    assert (guesses.examples, guesses.phrases) == (("red",), tuple(book))  # all that is known are colours


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("te", ["teddy bear", "tea pot", "teapot"]),
        ("TEA ", []),
        ("tea p", ["tea pot"]),
        ("red te", ["red teddy", "red tea", "red teapot"]),
        ("blue mu", ["blue mug"]),
        ("mug", []),
        ("", []),
        ("zebra", []),
    ],
)
def test_completions_continue_the_typed_text(typed, offered):
    assert completions(typed, PHRASES) == offered
    assert completions(typed, PHRASES, at_most=1) == offered[:1]


def test_correction_replaces_unknown_words_only():
    assert corrected("the Red mugg", {"mugg": ("mug", "muff")}) == "the red mug"
    assert corrected("red mugg", {"mugg": ()}) is None
