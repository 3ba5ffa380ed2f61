"""Answers by regions and by the peak, what is said about them, and words that are taught by showing."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.arrays import Array, sigmoid, unit
from langsplat_core.errors import EncoderError, InputError
from langsplat_core.io.sidecar import Words
from langsplat_core.query.answers import (
    QueryResult,
    Regions,
    build_regions,
    by_peak,
    by_regions,
    smoothed,
    touching_wholes,
)
from langsplat_core.query.compose import check_phrase, run_phrase
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.grammar import Named, named
from langsplat_core.query.lookup import Relevancy
from langsplat_core.query.rule import (
    RULE,
    Bar,
    RegionTable,
    Verdict,
    bars_of,
    common_fits,
    decide,
    excess,
    judge,
    on_things,
    region_fits,
    scaling_of,
)
from langsplat_core.query.taught import FOUND, LIKEST, NEXT, of_example
from langsplat_core.scene import (
    LEVELS,
    NO_NODE,
    Calibration,
    Gaussians,
    LanguageField,
    PlattScaling,
    Scene,
    TaughtWord,
    Tree,
)
from langsplat_core.scene.codec import CodebookCodec
from langsplat_core.scene.language import LONGEST_NAME, MOST_SHOWN
from langsplat_core.scene.surface import SMALLEST, build_surface, surface_weights
from langsplat_core.semantics.relevancy import FLOOR, Scale, TextEncoder, fit_of
from tests.support.fakes import CENTRES, PER_BLOB, FakeEncoder, blob_scene, blobs, language
from tests.support.file_samples import random_field
from tests.support.scenes import (
    chain_of_levels,
    random_gaussians,
    regions_of,
    tree_of_wholes,
    unturned_gaussians,
    with_tree,
)

RULES = ("regions", "peak")
SURE = Calibration(*[PlattScaling(constant=0.0, whole=20.0, finer=2.0, found=0.8)] * 3)


def calibrated(calibration: Calibration | None) -> QueryEngine:
    scene = blob_scene()
    field = replace(language(), calibration=calibration)
    return QueryEngine(replace(scene, language=field), lambda _: FakeEncoder())


def asked(relevancy, gaussians: Gaussians, field: LanguageField, rule: str, level="auto") -> QueryResult:
    surface = build_surface(gaussians)
    scale = Scale(field.canonical, field.everyday, field.temperature)
    if rule == "peak":
        return by_peak("x", relevancy, gaussians.means, surface, scale, field.found, level)
    regions = regions_of(Scene(gaussians, field), surface)
    return by_rule(relevancy, regions, gaussians.means, scale, "thing", level)


def by_rule(relevancy, regions: Regions, means: Array, scale: Scale, sought: Named, level) -> QueryResult:
    """Answer to (3, N) relevancy, every number of which is a feature of its own."""
    values = np.append(relevancy, 0).astype(np.float32)
    of_features = Relevancy(values, np.arange(values.size - 1).reshape(np.shape(relevancy)))
    own = scale.fit(np.concatenate(regions.means(relevancy)))
    decision = decide(regions.table, [own], sought, level, BARS, None)
    return by_regions("x", of_features, decision, means, regions)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("kind", ["codebook", "autoencoder", "linear"])
@pytest.mark.parametrize("level", ["auto", *LEVELS])
def test_answers_are_finite_and_repeatable_for_every_codec(kind, rule, level):
    gaussians, field = random_gaussians(300), random_field(300, kind)
    result = QueryEngine(Scene(gaussians, field), rule=rule).run("red mug", level)
    again = QueryEngine(Scene(gaussians, field), rule=rule).run("red mug", level)
    for name in ("relevancy", "even", "members", "place", "box"):
        np.testing.assert_array_equal(getattr(result, name), getattr(again, name))
        assert np.isfinite(getattr(result, name)).all()
    assert (result.relevancy.shape, result.even.shape, result.members.shape) == ((3, 300), (300,), (300,))
    assert (result.even.dtype, result.members.dtype) == (np.float32, bool)
    assert result.members.any()
    assert level in ("auto", LEVELS[result.level])
    assert np.isfinite([*result.scores, *result.fits]).all()
    assert result.peak == result.scores[result.level]
    assert result.probability is None
    rate = 10 if rule == "peak" else 1
    np.testing.assert_allclose(sigmoid(rate * np.array(result.fits)), result.scores, atol=1e-5)


@pytest.mark.parametrize("rule", RULES)
def test_answer_members_are_the_thing_asked_for(rule):
    engine = QueryEngine(blob_scene(), lambda _: FakeEncoder(), rule=rule)
    result = engine.run("book")
    assert (result.level, result.found, result.verdict) == (2, True, "found")
    np.testing.assert_array_equal(np.flatnonzero(result.members), np.arange(PER_BLOB, 2 * PER_BLOB))
    np.testing.assert_allclose(result.place, CENTRES[1], atol=0.2)
    assert (np.abs(result.box - CENTRES[1]) < 0.7).all()

    # As a whole a mug is there; among the parts nothing is more of a mug than of an object.
    assert engine.run("mug", "whole").found
    part = engine.run("mug", "part")
    assert part.fits[1] < part.fits[2]
    assert not part.found


def test_place_ignores_crumbs():
    """A few stray Gaussians far off mean it more than the thing does, and are no thing."""
    far, gaussians = np.arange(SMALLEST - 1), blobs()
    gaussians.means[far] += np.array([60, 0, 0], np.float32)
    relevancy = np.full((3, len(gaussians)), 0.3, np.float32)
    relevancy[:, PER_BLOB : 2 * PER_BLOB] = 0.8
    relevancy[2, far] = 0.95
    result = asked(relevancy, gaussians, language(), "regions")
    assert result.peak == pytest.approx(0.8, abs=1e-6)
    np.testing.assert_allclose(result.place, CENTRES[1], atol=0.3)
    assert result.box[1][0] < 30


@pytest.mark.parametrize(("finer", "level"), [(0.3, 2), (0.9, 1)])
def test_thing_is_whole_unless_a_part_fits_clearly_better(finer, level):
    relevancy = np.full((3, 3 * PER_BLOB), 0.3, np.float32)
    relevancy[:2, :PER_BLOB] = sigmoid(1.0 + finer)
    relevancy[2, :PER_BLOB] = sigmoid(1.0)
    assert asked(relevancy, blobs(), language(), "regions").level == level


@pytest.mark.parametrize(
    ("below", "verdict"), [(0.1, "found"), (-0.5, "weak match"), (-1.5, "not here"), (9.0, "found")]
)
def test_calibrated_verdict_follows_the_probability(below, verdict):
    """`below`: what the odds of the book's whole lie above those that are even by, as a logit, less 1."""
    fit = calibrated(None).run("book").fits[2]
    odds = PlattScaling(1 + below - 2 * fit, whole=2.0, finer=0.0, found=sigmoid(np.array(1.0)).item())
    never = PlattScaling(-99.0, whole=2.0, finer=0.01)
    result = calibrated(Calibration(odds, never, never)).run("book")
    assert result.probability == pytest.approx(1 / (1 + np.exp(-(1 + below))))
    assert (result.found, result.verdict) == (verdict == "found", verdict)


@pytest.mark.parametrize("rule", RULES)
def test_negative_fits_give_no_answer(rule):
    gaussians, field = random_gaussians(200), random_field(200, "codebook")
    relevancy = np.random.default_rng(0).uniform(0.05, 0.2, (3, 200)).astype(np.float32)
    for level in ("auto", *LEVELS):
        result = asked(relevancy, gaussians, field, rule, level)
        assert (result.found, result.verdict) == (False, "not here")
        assert max(result.fits) < 0
        assert result.heat_range == (FLOOR, pytest.approx(FLOOR + 0.1))
        assert np.isfinite([*result.place, *result.box.ravel()]).all()


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("calibration", [None, SURE])
@pytest.mark.parametrize("count", [0, 1, 150])
def test_scenes_without_features_give_finite_answers(rule, calibration, count):
    field = replace(random_field(count), calibration=calibration)
    if count > 1:
        field = replace(field, latents=0 * field.latents, confidence=0 * field.confidence)
    result = QueryEngine(Scene(random_gaussians(count), field), rule=rule).run("red mug")
    assert not result.found
    assert result.members.shape == (count,)
    assert np.isfinite([*result.scores, *result.fits]).all()
    if count > 1:
        assert (result.verdict, result.place, result.scores) == ("not here", None, (0, 0, 0))


# What everyday phrases fit in a scene, and what is found because it fits more.

TOLERANCE = {"codebook": 1e-4, "linear": 1e-4, "autoencoder": 5e-3}  # of the table that finds relevancies
BARS = (Bar(0.0, 1.0), Bar(0.5, 1.0), Bar(-1.0, 2.0), Bar(0.6, 0.5))


@pytest.mark.parametrize("kind", ["codebook", "autoencoder", "linear"])
def test_chance_equals_fits_of_everyday_phrases(kind):
    engine = QueryEngine(Scene(random_gaussians(400), random_field(400, kind)))
    fits = engine.chance
    for number, vector in enumerate(engine.field.everyday):
        means = np.concatenate(engine.regions.means(engine.relevancy(vector)))
        want = region_fits(engine.regions.table, engine.scale.fit(means))
        np.testing.assert_allclose(fits[:, number], want, atol=TOLERANCE[kind])


def test_bars_are_quantiles_of_the_best_fits():
    fits, solid = np.random.default_rng(0).normal(size=(3, 9, 101)), np.arange(27) % 9 != 4
    fits[:, 4] += 9  # crumbs, which do not count
    table = RegionTable(np.full((1, 3), 9), np.full(27, -1), solid)
    bars = bars_of(table, fits.reshape(27, 101))
    heard = np.delete(fits, 4, axis=1)
    best = heard.max(1) - RULE.common_share * heard.mean((0, 1))
    for bar, level in zip(bars, (*best, best[:2].max(0)), strict=True):
        low, median = np.quantile(level, [0.16, 0.5])
        assert (bar.median, bar.spread) == (pytest.approx(median), pytest.approx(median - low))
    some = bars_of(table, fits.reshape(27, 101), np.isin(np.arange(27), [2, 9, 10]))
    assert some[0].median == pytest.approx(np.median(fits[0, 2]))
    assert not np.isfinite(some[2].median)  # nothing is found where there is nothing
    assert np.isfinite(bars_of(replace(table, solid=~solid & False), fits.reshape(27, 101))[0].median)


def test_common_fits_are_means_over_what_has_features():
    """Of each scene: neither crumbs nor what has no feature of a phrase count."""
    solid = np.array([True, True, False, True, True, True])
    table = RegionTable(np.array([[2, 1, 1], [0, 0, 0], [1, 1, 0]]), np.full(6, -1), solid)
    fits = np.array([1.0, 2.0, 9.0, RULE.nothing, 5.0, 7.0])
    np.testing.assert_allclose(common_fits(table, fits), [1.5, 0, 6])
    np.testing.assert_allclose(common_fits(table, np.stack([fits, 2 * fits], 1)), [[1.5, 3], [0, 0], [6, 12]])


def test_verdicts_by_chance_leave_out_what_lies_near_everything():
    fits = (1.0, 2.0, 3.0)
    near = judge(fits, "thing", "auto", BARS, None, common=1 / RULE.common_share)
    by_hand = judge((0.0, 1.0, 2.0), "thing", "auto", BARS, None)
    assert near.margin == pytest.approx(by_hand.margin)
    scaling = PlattScaling(-2.0, 1.5, 0.5, common=0.75)
    told = [judge(fits, "thing", "auto", None, scaling, common).margin for common in (0.0, 2.0)]
    assert told[1] - told[0] == pytest.approx(1.5)


def test_common_fit_of_a_part_is_of_its_thing_alone():
    own, on = np.array([0.2, -1.0, 0.7, -0.4, 1.1, 0.3]), np.arange(6) % 2 == 0
    decision = decide(TWO, [own], "inside", "auto", BARS, None, on)
    assert decision.common == pytest.approx(region_fits(TWO, own)[on].mean())


def test_ways_of_looking_have_calibrations_of_their_own():
    ways = [PlattScaling(number, 1, 1) for number in range(5)]
    phrases = ("orange", "pale Orange mug", "lid", "blue lid", "mug lid")
    for known, used in ((Calibration(*ways), [0, 3, 1, 4, 1]), (Calibration(*ways[:3]), [0, 0, 1, 1, 1])):
        assert [scaling_of(known, named(text), text) for text in phrases] == [ways[k] for k in used]
        assert scaling_of(known, "inside", "blue lid") == ways[2]


@pytest.mark.parametrize(("margin", "said"), [(0.0, "5 %"), (1.0, "0.7 %"), (-1.0, "28 %"), (9.0, "0.1 %")])
def test_verdicts_by_chance_say_how_often_chance_fits_as_well(margin, said):
    verdict = Verdict(margin >= 0, "chance", margin)
    assert verdict.by_chance == pytest.approx(1 / (1 + 19 * np.exp(2 * margin)))
    answer = replace(calibrated(None).run("book"), judgement=verdict)
    assert answer.said == f"{verdict.outcome}, by chance {said}"
    assert verdict.absent.by_chance == 1
    there = replace(answer, judgement=Verdict(False, "calibration", 0.5, 0.94))
    assert there.said == "weak match, 94 % at another level"
    for other, told in (
        (Verdict(True, "calibration", 1.0, 0.83), "found, 83 %"),
        (Verdict(True, "example", 1.0), "found"),
    ):
        assert (other.by_chance, replace(answer, judgement=other).said) == (None, told)


@pytest.mark.parametrize("named", RULE.found)
def test_excess_is_counted_from_the_bars(named):
    whole, finer = RULE.found[named]
    least = min(whole, finer)
    for fits, by_whole, by_finer in (((1.0, 2.0, 9.0), 5.0, 2.8), ((3.6, 2.0, -1.0), 0.0, 6.0)):
        by_level = fits[0] - least, fits[1] - 0.5 - least, by_whole - least
        got = [excess(fits, BARS, named, level) for level in ("auto", *LEVELS)]
        assert got == pytest.approx([max(by_whole - whole, by_finer - finer), *by_level])
    assert np.isfinite(Bar(0.3, 0.0).excess(0.3, 1.0))  # without width


def test_peak_rule_answers_without_everyday_phrases():
    field = replace(language(), everyday=None, found=0.6)
    scene = replace(blob_scene(), language=field)
    engine = QueryEngine(scene, lambda _: FakeEncoder())  # which knows too few of them
    assert (engine.rule, engine.bars, engine.calibration) == ("peak", None, None)
    result = engine.run("mug")
    assert (result.found, result.judgement.reached, result.probability) == (True, "relevancy", None)
    few = replace(field, everyday=np.ones((3, 8), np.float32))
    assert QueryEngine(replace(scene, language=few), lambda _: FakeEncoder()).rule == "peak"


# How far an answer reaches, and where.

# Two wholes, each with one part of one subpart. A part that fits better than all is on the second one.
TWO = RegionTable(np.array([[2, 2, 2]]), np.array([2, 3, 4, 5, -1, -1]), np.ones(6, bool))


@pytest.mark.parametrize(("best", "reach"), [(-1.0, 0.15), (0.1, 0.15), (1.0, 0.45), (4.0, 1.0)])
@pytest.mark.parametrize("level", LEVELS)
def test_an_answer_reaches_further_below_a_better_best(best, reach, level):
    for below, second in ((reach - 1e-3, True), (reach + 1e-3, False)):
        found = decide(TWO, [np.tile([best, best - below], 3)], "thing", level, BARS, None)
        assert (LEVELS[found.level], found.inside.tolist()) == (level, [True, second])
        assert found.fits == pytest.approx((best,) * 3)


def test_the_best_part_of_a_region_counts_a_quarter():
    own = np.array([4.0, 0.0, 2.0, 0.0, 1.0, 1.0])
    np.testing.assert_allclose(region_fits(TWO, own), [4, 0, 2.5, 0, 1.25, 0.75])


@pytest.mark.parametrize(
    ("first", "second", "touching", "level", "answer"),
    [
        (2.0, -1.0, [0, 1], "auto", (0, [True, False])),
        (2.0, 1.0, [0, 1], "auto", (0, [False, True])),  # nearly as much the thing
        (2.0, -1.0, [1, 0], "auto", (0, [False, True])),  # may be a piece of the thing
        (2.0, -1.0, [0, 1], "whole", (2, [True, False])),
    ],
)
def test_parts_are_looked_for_on_wholes_of_their_thing(first, second, touching, level, answer):
    own = np.array([1.5, 2.5, 0.0, 0.0, 0.5, 3.0])
    on = on_things(TWO, np.array([-2.0, -2.0, -2.0, -2.0, first, second]), np.array([touching]))
    decision = decide(TWO, [own], "part of a thing", level, BARS, None, on)
    assert (decision.level, decision.inside.tolist()) == answer
    assert decision.fits == decide(TWO, [own], "part of a thing", level, BARS, None).fits
    inside = decide(TWO, [own], "inside", level, BARS, None, on)  # nothing off the thing is evidence
    assert inside.fits == pytest.approx(fit_of(np.array(decision.scores)).tolist())


def test_touching_wholes_share_a_fifth_of_their_borders():
    x, y = np.mgrid[:24, :24].reshape(2, -1)
    things = np.select([(x > 7) & (x % 3 < 2) & (y < 2), x < 2, x < 7], [1 + x // 3, 2, 1])  # tiles, strips
    gaussians = unturned_gaussians(np.stack([x, y, 0 * x], 1).astype(np.float32), -1.0, 5.0)
    regions = build_regions(chain_of_levels(things.astype(np.int32)), surface_weights(gaussians))
    surface = build_surface(gaussians)
    assert touching_wholes(regions, surface.ends, surface.rows).tolist() == [[1, 0], [2, 1]]


def test_parts_are_searched_on_touching_wholes_found_by_a_sample(monkeypatch):
    at = np.random.default_rng(0).uniform(0, 24, (6_000, 2))
    things = np.select([at[:, 0] < 1, at[:, 0] < 4, at[:, 0] < 12, at[:, 0] > 18], [0, 1, 2, 3], NO_NODE)
    gaussians = unturned_gaussians(np.pad(at, ((0, 0), (0, 1))).astype(np.float32), -1.0, 5.0)
    field = replace(random_field(6_000, "codebook"), tree=tree_of_wholes(things))
    for sample in (200_000, 1_500):
        monkeypatch.setattr("langsplat_core.query.engine.SAMPLE", sample)
        assert QueryEngine(Scene(gaussians, field)).touching.tolist() == [[0, 1], [1, 2]]
    part = QueryEngine(Scene(gaussians, field)).run_inside(["red mug"], things == 1, "whole", None)
    assert [part.even[things == thing].any() for thing in range(4)] == [True, True, False, False]


def test_part_is_chosen_by_its_phrase_and_its_own_word():
    phrase, word = np.array([1.5, 1.0, 0.0, 0.0, 0.5, 0.5]), np.array([0.0, 2.0, 0.0, 0.0, 0.5, 0.5])
    asked = decide(TWO, [phrase, word], "part of a thing", "auto", BARS, None, np.ones(6, bool))
    assert asked.inside.tolist() == [False, True]
    assert asked.fits == decide(TWO, [phrase], "part of a thing", "auto", BARS, None).fits


# Words taught by showing, in scenes whose regions have the statistics of images: a gap between image and
# text, much that no words describe, and things that are alike.

DIM, KINDS, SPAN = 96, 40, 32  # vectors; things there are; directions in which words differ
EACH = 40  # Gaussians of a thing
RNG = np.random.default_rng(5)
WALL = KINDS - 1  # of which every scene has several pieces, as rooms have
PIECES = 8
FEATURES = unit(RNG.normal(size=(KINDS, SPAN)) @ np.linalg.qr(RNG.normal(size=(DIM, SPAN)))[0].T)
GAP = unit(RNG.normal(size=DIM))


def row_of(things: list[int], seed: int) -> Scene:
    """A row of things of these kinds and of pieces of a wall, of which there is no mask, apart from each
    other. Their vectors have a cosine of 0.6 and more with each other, whatever they are."""
    rng = np.random.default_rng(seed)
    things = things + PIECES * [WALL]
    looks = FEATURES[things] + 0.2 * unit(rng.normal(size=(len(things), DIM)))
    vectors = unit(1.6 * GAP + 0.7 * looks + 0.9 * unit(rng.normal(size=(len(things), DIM))))
    codec = CodebookCodec(vectors.astype(np.float32), np.zeros((len(things), 3), np.float32))
    of = np.repeat(np.arange(len(things)), EACH)
    places = np.stack([4.0 * of, 0 * of, 0 * of], 1) + rng.normal(scale=0.15, size=(len(of), 3))
    field = LanguageField(
        latents=np.tile(of.astype(np.uint16)[:, None], (3, 1, 1)),
        confidence=np.ones((3, len(of)), np.float32),
        codec=codec,
        canonical=np.tile(unit(GAP + FEATURES[0]).astype(np.float32), (4, 1)),
        encoder_id="images",
        everyday=unit(0.8 * unit(FEATURES.mean(0)) + FEATURES).astype(np.float32),
        tree=tree_of_wholes(np.where(of < len(things) - PIECES, of, NO_NODE)),
    )
    return with_tree(Scene(unturned_gaussians(places, np.log(0.08), 2.0), field))


def test_smoothing_follows_what_varies_slowly_and_evens_out_noise():
    rng = np.random.default_rng(3)
    points = rng.uniform(size=(4000, 3)).astype(np.float32) * (4, 2, 0.01) + 100
    slow = 0.5 + 0.1 * (points[:, 0] - 102)
    noisy = (slow + rng.normal(scale=0.1, size=4000)).astype(np.float32)
    found = smoothed(points, noisy)
    assert found.dtype == np.float32
    assert np.sqrt(np.mean((found - slow) ** 2)) < 0.04
    np.testing.assert_allclose(smoothed(1e-3 * points, noisy), found, atol=1e-3)  # lengths have no unit
    for alike in (points[:1], np.tile(points[:1], (50, 1)), np.full((3, 3), np.nan)):
        values = np.linspace(0, 1, len(alike), dtype=np.float32)
        np.testing.assert_allclose(smoothed(alike, values), values.mean(), atol=1e-6)
    assert smoothed(points[:0], noisy[:0]).shape == (0,)


def members(place: int, count: int) -> Array:
    return np.repeat(np.arange(count + PIECES) == place, EACH)


ROOM = list(range(24))
SHOWN = row_of(ROOM, seed=1)


def taught(kind: int, name: str = "grandma's vase") -> TaughtWord:
    """The word for one thing of `SHOWN`."""
    return QueryEngine(SHOWN).teach(name, members(kind, len(ROOM)))


def asking(scene: Scene, *words: TaughtWord) -> QueryEngine:
    return QueryEngine(Scene(scene.gaussians, replace(scene.language, taught=words)))


def test_taught_words_find_their_things_in_other_scenes():
    there = row_of(list(range(12)) + list(range(24, 36)), seed=2)
    answers = [asking(there, taught(kind)).run("grandma's vase") for kind in ROOM]
    right = [answer.found and answer.members[members(kind, 24)].all() for kind, answer in enumerate(answers)]
    assert np.mean(right[:12]) >= 0.8
    assert np.mean([answer.found for answer in answers[12:]]) <= 0.25
    for answer in answers:
        assert answer.verdict == ("found" if answer.judgement.margin >= 0 else answer.verdict)
        assert answer.probability is None
        assert answer.members.any()
        assert answer.box is not None
        assert 0 <= answer.relevancy.min() <= answer.relevancy.max() <= 1
        assert (answer.peak >= 0.5) == answer.found


def test_rival_of_a_shown_whole_follows_from_the_next_ones():
    engine, number = QueryEngine(SHOWN), len(ROOM)
    space, there = engine.word_space, members(3, number)
    given = space, engine.field, engine.regions
    own = engine.regions.everywhere[2][there][0]
    alike = np.sort(np.delete(space.regions[2] @ space.regions[2][own], own))[-NEXT:].mean()
    base, times = FOUND[2]
    assert space.rival <= LIKEST
    for rival in (0.0, 0.9):
        (said,) = of_example(replace(space, rival=rival), *given[1:], "vase", there, 2).rivals
        assert said == pytest.approx(min(rival, ((1 + alike) / 2 - base) / times), abs=1e-3)


def test_taught_word_finds_every_thing_and_places_the_best():
    there = row_of([*range(6, 24), 3, 30, 3], seed=3)
    answer = asking(there, taught(3)).run("Grandma’s vase")
    assert set(np.flatnonzero(answer.members) // EACH) == {18, 20}
    assert len(QueryEngine(there).instances(answer)) == 2
    assert min(abs(answer.place[0] - 4 * 18), abs(answer.place[0] - 4 * 20)) < 0.5


def test_like_equals_teach_and_run_without_keeping():
    engine = QueryEngine(row_of([*range(20), 3], seed=4))
    alike = engine.like(members(3, 21))
    assert engine.taught == {}
    found = set(np.flatnonzero(alike.members) // EACH)
    assert found >= {3, 20}
    assert len(found) <= 3  # of 29
    engine.teach("vase", members(3, 21))
    np.testing.assert_array_equal(engine.run("vase").members, alike.members)


def test_further_example_is_found_too():
    engine = QueryEngine(SHOWN)
    engine.teach("both", members(3, 24))
    word = engine.teach("Both!", members(9, 24))
    assert len(word.vectors) == len(word.rivals) == 2
    assert set(np.flatnonzero(engine.run("both").members) // EACH) == {3, 9}
    with pytest.raises(InputError, match="taught at level whole"):
        engine.teach("both", members(3, 24), "part")
    for _ in range(MOST_SHOWN - 2):
        engine.teach("both", members(3, 24))
    with pytest.raises(InputError, match="remove it first"):
        engine.teach("both", members(3, 24))


def test_words_of_another_encoder_are_refused():
    words = (taught(3),)
    canonical = SHOWN.language.canonical
    QueryEngine(SHOWN, words=Words("the same elsewhere", canonical, words))
    for other in (np.roll(canonical, 1, 1), canonical[:, :-1].copy()):
        with pytest.raises(EncoderError, match=r"taught with clip.* made with images"):
            QueryEngine(SHOWN, words=Words("clip", other, words))


class OneVector(FakeEncoder):
    """Knows every word but "vase", and all as the same."""

    def encode_texts(self, texts):
        return np.tile(SHOWN.language.canonical[:1], (len(texts), 1))

    def unknown_words(self, text):
        return tuple(word for word in text.split() if word == "vase")


def test_taught_name_replaces_text_in_phrases():
    engine = QueryEngine(SHOWN, lambda _: OneVector())
    engine.teach("vase on the left", members(3, 24))
    alone = run_phrase(engine, "the vase on the left")
    assert alone.answer.found
    assert set(np.flatnonzero(alone.answer.members) // EACH) == {3}
    check_phrase(engine, "vase on the left or a table")
    both = run_phrase(engine, "vase on the left and vase on the left")
    np.testing.assert_array_equal(both.answer.members, alone.answer.members)
    many = engine.run_many(["table", "Vase on the left", "chair"])
    assert [answer.phrase for answer in many] == ["table", "vase on the left", "chair"]
    np.testing.assert_array_equal(many[1].members, alone.answer.members)
    np.testing.assert_allclose(many[2].relevancy, engine.run("chair").relevancy, atol=1e-5)
    assert engine.unknown_words("vase on the left") == ()
    assert engine.unknown_words("vase") == ("vase",)


@pytest.mark.parametrize("name", ["", " ?! ", "the", "a; b", "a, b", "x" * (LONGEST_NAME + 1)])
def test_invalid_names_are_refused(name):
    engine = QueryEngine(SHOWN)
    with pytest.raises(InputError, match="cannot be a name"):
        engine.teach(name, members(3, 24))
    assert engine.taught == {}


def test_gaussians_without_features_cannot_be_taught():
    dark = Scene(SHOWN.gaussians, replace(SHOWN.language, confidence=0 * SHOWN.language.confidence))
    for scene, some in ((SHOWN, np.zeros(len(SHOWN.gaussians), bool)), (dark, members(3, 24))):
        with pytest.raises(InputError, match="point at something else"):
            QueryEngine(scene).teach("vase", some)


def test_tiny_scenes_answer_taught_words():
    for things in ([3], [3, 3], [30, 31]):
        scene = row_of(things, seed=6)
        for everyday in (scene.language.everyday, None):
            field = replace(scene.language, everyday=everyday, taught=(taught(3),))
            answer = QueryEngine(Scene(scene.gaussians, field), rule="peak").run("grandma's vase")
            assert np.isfinite([answer.judgement.margin, *answer.relevancy.ravel()]).all()
            assert answer.members.shape == (len(scene.gaussians),)
    nothing = asking(SHOWN.take(np.zeros(0, int)), taught(3)).run("grandma's vase")
    assert (nothing.found, nothing.place) == (False, None)


def test_teaching_takes_the_level_of_the_marked_region():
    scene = row_of([*range(8)], seed=7)
    leaves = (np.arange(len(scene.gaussians)) // EACH).astype(np.int32)
    count, pairs = int(leaves.max()) + 1, int(leaves.max()) // 2 + 1  # wholes of two things each
    parents = np.concatenate([count + np.arange(count) // 2, np.full(pairs, NO_NODE)]).astype(np.int32)
    levels = np.repeat(np.array([1, 2], np.uint8), [count, pairs])
    tree = Tree(leaves, parents, levels, np.zeros((count + pairs, 2), np.uint16))
    engine = QueryEngine(Scene(scene.gaussians, replace(scene.language, tree=tree)))
    assert engine.teach("one", members(3, 8)).level == 1
    assert engine.teach("two", members(2, 8) | members(3, 8)).level == 2


@pytest.mark.parametrize(
    "change",
    [
        {"name": ""},
        {"name": "a, b"},
        {"level": 3},
        {"vectors": np.zeros((0, DIM), np.float32), "rivals": np.zeros(0, np.float32)},
        {"vectors": np.ones((1, DIM), np.float32)},
        {"rivals": np.array([np.nan], np.float32)},
        {"rivals": np.array([0.5, 0.5], np.float32)},
    ],
)
def test_malformed_taught_word_is_refused(change):
    with pytest.raises(ValueError, match=r"taught word|rivals: expected"):
        replace(taught(3), **change)


def test_taught_names_are_unique_in_a_field():
    with pytest.raises(ValueError, match="two words have one name"):
        replace(SHOWN.language, taught=(taught(3), taught(4, "Grandma’s  vase")))
    short = replace(taught(3), vectors=np.eye(1, 8, dtype=np.float32))
    with pytest.raises(ValueError, match="taught"):
        replace(SHOWN.language, taught=(short,))


def test_taught_words_and_refusals_leave_the_encoder_alone():
    def offline(_: str) -> TextEncoder:
        loads.append(1)
        raise EncoderError("offline")

    loads: list[int] = []
    field = replace(SHOWN.language, everyday=None, taught=(taught(3),))
    engine = QueryEngine(Scene(SHOWN.gaussians, field), offline)
    engine.run("grandma's vase")
    assert loads == []
    with pytest.raises(EncoderError, match="offline"):
        engine.run("zebra")
    assert loads == [1]
