"""Words of meanings, against a plain float64 reference."""

import numpy as np
import pytest

from langsplat_core.arrays import Array, unit
from langsplat_core.query import describe as words_module
from langsplat_core.query.describe import (
    NEAREST,
    WordScores,
    build_attributes,
    build_words,
    certain,
    hubs,
    meanings,
)
from langsplat_core.scene import LanguageField, LinearCodec
from langsplat_core.scene.codec import CodebookCodec

D, K, N, V = 24, 40, 90, 17


def field(kind: str) -> LanguageField:
    """Random meanings, by a codebook or by a linear codec; every seventh Gaussian has none."""
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
    hub = []
    for word in every:
        cosines = sorted((float(word @ meaning) for meaning in bank.astype(np.float64)), reverse=True)
        hub.append(np.mean(cosines[:NEAREST]))
    spreads = [np.std([float(word @ meaning) for word in every[: len(vectors)]]) for meaning in bank]
    rows, scale = [], words_module.WORD_SCALE / np.median(spreads)
    for vector in made.codec.decode(latents).astype(np.float64):
        fits = np.array([scale * (vector @ word - own / 2) for word, own in zip(every, hub, strict=True)])
        shares = np.exp(fits - fits.max())
        rows.append(shares / shares.sum())
    return np.array(rows)


@pytest.mark.parametrize("kind", ["codebook", "linear"])
def test_probabilities_and_mixtures_are_those_of_the_formula(kind, monkeypatch):
    monkeypatch.setattr(words_module, "CELLS", 7 * (V + 4))  # several blocks
    made = field(kind)
    names, vectors = phrases()
    words = build_words(made, names, vectors)
    latents = made.latents[made.known][:60]
    want = plain_probabilities(made, vectors, latents, meanings(made))
    np.testing.assert_allclose(words.probabilities(made.codec, latents), want, atol=2e-5)
    weights = np.random.default_rng(6).uniform(size=len(latents))
    mixture = words.mixture(made.codec, latents, weights)
    np.testing.assert_allclose(mixture, weights @ want / weights.sum(), atol=2e-5)
    best, shares = words.best(made.codec, latents, 3)
    order = np.argsort(-want[:, :V], axis=1)[:, :3]
    assert (best == order).mean() > 0.99  # equal but for rounding
    np.testing.assert_allclose(shares, np.take_along_axis(want, order, 1), atol=2e-5)


def test_the_bank_holds_every_meaning_that_some_gaussian_has_once():
    made = field("codebook")
    used = np.unique(made.latents[made.known])
    assert 0 < len(used) <= K
    np.testing.assert_array_equal(meanings(made), made.codec.vectors[used])
    assert len(meanings(field("linear"))) == field("linear").known.sum()


def test_hubs_of_few_or_no_meanings():
    vectors = np.eye(D, dtype=np.float32)[:2]
    np.testing.assert_allclose(hubs(vectors, np.eye(D, dtype=np.float32)[:4]), [0.25, 0.25])
    np.testing.assert_array_equal(hubs(vectors, np.zeros((0, D), np.float32)), [0, 0])


def test_a_word_that_is_near_everything_is_not_the_answer_everywhere():
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
    latents = codes[0]
    right = (build_words(made, labels, vectors).best(codec, latents, 1)[0][:, 0] == np.arange(40)).mean()
    plain = (build_attributes(made, labels, vectors).best(codec, latents, 1)[0][:, 0] == np.arange(40)).mean()
    assert plain < 0.2
    assert right > 0.8


def test_very_different_cosines_do_not_overflow():
    made = field("codebook")
    names, vectors = phrases()
    words = WordScores(names, vectors, np.zeros(V, np.float32), 1e6)
    found = words.probabilities(made.codec, made.latents[0])
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found.sum(1), 1, atol=1e-5)


def test_the_canonical_phrases_take_what_no_word_fits():
    made = field("codebook")
    names, vectors = phrases()
    latents = made.latents[made.known][:1]
    like = made.codec.decode(latents)
    nothing = LanguageField(made.latents, made.confidence, made.codec, np.repeat(like, 4, 0), "none")
    assert build_words(nothing, names, vectors).mixture(made.codec, latents, np.ones(1))[V:].sum() > 0.9


def test_an_attribute_is_said_where_it_is_certain():
    made = field("codebook")
    latents = np.array([[3], [3], [8]], np.uint16)
    own = made.codec.vectors[[3, 8]]
    colours = build_attributes(made, ("red", "blue"), own)
    said = certain(colours, made.codec, latents, np.ones(3))
    assert said is not None
    assert said.phrase == "red"
    assert 0.5 <= said.probability < 0.7
    alike = build_attributes(made, ("a", "b", "c"), np.repeat(own[:1], 3, 0))
    assert certain(alike, made.codec, latents, np.ones(3)) is None


def test_words_that_are_taken_keep_their_numbers():
    made = field("codebook")
    names, vectors = phrases()
    words = build_words(made, names, vectors)
    few = words.take(np.arange(V) % 2 == 0)
    assert few.phrases == names[::2]
    assert len(few.vectors) == len(few.phrases) + 4
    np.testing.assert_array_equal(few.vector("word 2"), words.vector("word 2"))
    nothing = words.take(np.zeros(V, bool))
    assert nothing.best(made.codec, made.latents[0], 5)[0].shape == (N, 0)
