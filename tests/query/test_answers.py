"""Answers by regions and by the peak, and what is said about them."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.arrays import sigmoid
from langsplat_core.query.answers import QueryResult, by_peak, by_regions, chance_in
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.surface import SMALLEST, Surface, build_regions, build_surface
from langsplat_core.scene import LEVELS, Calibration, Gaussians, LanguageField, Odds, Reading, Scene
from langsplat_core.semantics.relevancy import FLOOR, Scale
from tests.support.fakes import CENTRES, PER_BLOB, FakeEncoder, blob_scene, blobs, language
from tests.support.file_samples import random_field
from tests.support.scenes import random_gaussians

RULES = ("regions", "peak")
SURE = Calibration(*[Odds(constant=0.0, whole=20.0, finer=2.0, found=0.8)] * 3)


def calibrated(calibration: Calibration | None) -> QueryEngine:
    scene = blob_scene()
    field = replace(language(), reading=Reading(calibration=calibration))
    return QueryEngine(replace(scene, language=field), lambda _: FakeEncoder())


def asked(
    relevancy, surface: Surface, field: LanguageField, rule: str, level="auto", phrase="x"
) -> QueryResult:
    scale = Scale(field.canonical, field.everyday, field.reading.temperature)
    if rule == "peak":
        return by_peak(phrase, relevancy, surface, scale, field.reading.found, level)
    regions, calibration = build_regions(surface, field), field.reading.calibration
    bars = chance_in(field, surface, regions, replace(scale, everyday=field.everyday[:9])).bars()
    return by_regions(phrase, relevancy, surface, regions, scale, bars, calibration, level)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("kind", ["codebook", "autoencoder", "linear"])
@pytest.mark.parametrize("level", ["auto", *LEVELS])
def test_whatever_is_asked_the_answer_is_sound(kind, rule, level):
    gaussians, field = random_gaussians(300), random_field(300, kind)
    engine = QueryEngine(Scene(gaussians, field), rule=rule)
    result = engine.run("red mug", level)
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


def test_an_answer_by_regions_has_their_borders():
    gaussians, field = random_gaussians(400), random_field(400, "linear")
    engine = QueryEngine(Scene(gaussians, field))
    result = engine.run("red mug")
    of = engine.regions.of[result.level]
    members, even = result.members[engine.surface.rows], result.even[engine.surface.rows]
    for number in range(of.max() + 1):
        assert len({*members[of == number].tolist()}) == 1
        assert len({*even[of == number].tolist()}) == 1
    assert even[members].min() > even[~members].max()
    assert even.max() == pytest.approx(result.peak, abs=1e-6)


@pytest.mark.parametrize("rule", RULES)
def test_the_answer_is_the_thing(rule):
    engine = QueryEngine(blob_scene(), lambda _: FakeEncoder(), rule=rule)
    result = engine.run("book")
    assert (result.level, result.found, result.verdict) == (2, True, "found")
    np.testing.assert_array_equal(np.flatnonzero(result.members), np.arange(PER_BLOB, 2 * PER_BLOB))
    np.testing.assert_allclose(result.place, CENTRES[1], atol=0.2)
    low, high = result.box
    assert ((low > CENTRES[1] - 0.7) & (high < CENTRES[1] + 0.7)).all()


@pytest.mark.parametrize("rule", RULES)
def test_a_level_at_which_the_thing_is_not_has_not_found_it(rule):
    """As a whole a mug is there; among the parts nothing is more of a mug than of an object."""
    engine = QueryEngine(blob_scene(), lambda _: FakeEncoder(), rule=rule)
    assert engine.run("mug", "whole").found
    result = engine.run("mug", "part")
    assert result.fits[1] < result.fits[2]
    assert not result.found


def test_a_crumb_is_no_place():
    """A few stray Gaussians far off mean it more than the thing does, and are no thing."""
    far = np.arange(SMALLEST - 1)
    gaussians = blobs()
    means = gaussians.means.copy()
    means[far] += np.array([60, 0, 0], np.float32)
    gaussians = Gaussians(
        means, gaussians.log_scales, gaussians.quats_wxyz, gaussians.opacity_logits, gaussians.sh
    )
    surface, field = build_surface(gaussians), language()
    relevancy = np.full((3, len(means)), 0.3, np.float32)
    relevancy[2, PER_BLOB : 2 * PER_BLOB] = 0.8
    relevancy[2, far] = 0.95
    result = asked(relevancy, surface, field, "regions")
    assert result.peak == pytest.approx(0.8, abs=1e-6)
    np.testing.assert_allclose(result.place, CENTRES[1], atol=0.3)
    assert result.box[1][0] < 30


@pytest.mark.parametrize(
    ("below", "verdict"), [(0.1, "found"), (-0.5, "weak match"), (-1.5, "not here"), (9.0, "found")]
)
def test_a_calibrated_verdict(below, verdict):
    """`below`: what the odds of the book's whole lie above those that are even by, as a logit, less 1."""
    fit = calibrated(None).run("book").fits[2]
    odds = Odds(1 + below - 2 * fit, whole=2.0, finer=0.0, found=sigmoid(np.array(1.0)).item())
    never = Odds(-99.0, whole=2.0, finer=0.01)
    result = calibrated(Calibration(odds, never, never)).run("book")
    assert result.probability == pytest.approx(1 / (1 + np.exp(-(1 + below))))
    assert (result.found, result.verdict) == (verdict == "found", verdict)


@pytest.mark.parametrize("phrase", ["handle", "the handle", "red handle", "Handles"])
def test_a_part_that_is_asked_for_alone_has_odds_of_its_own(phrase):
    gaussians, field = random_gaussians(300), random_field(300, "codebook")
    relevancy = np.full((3, 300), 0.4, np.float32)
    relevancy[1, :100] = 0.7  # among the parts it is there, among wholes it is not
    calibration = Calibration(Odds(0, 20, 0), Odds(0, 0, 20), Odds(-99, 1, 1))
    field = replace(field, reading=Reading(calibration=calibration))
    surface = build_surface(gaussians)
    part, thing = (asked(relevancy, surface, field, "regions", phrase=text) for text in (phrase, "mug"))
    assert part.fits == thing.fits
    assert part.probability == pytest.approx(sigmoid(np.array(20 * max(part.fits[:2]))))
    assert part.probability > 0.5 > thing.probability
    assert (thing.found, thing.probability) == (False, pytest.approx(sigmoid(np.array(20 * part.fits[2]))))


def test_probability_is_of_being_there_at_all():
    """It knows no level: what is asked for at another one is there all the same. The peak, whose scale is
    another, has none."""
    scene = calibrated(SURE).scene
    assert QueryEngine(scene, lambda _: FakeEncoder(), rule="peak").run("mug").probability is None
    engine = QueryEngine(scene, lambda _: FakeEncoder())
    said = {engine.run("mug", level).probability for level in ("auto", *LEVELS)}
    assert len(said) == 1
    assert min(said) > 0.99
    assert calibrated(None).run("mug").probability is None


def test_of_the_peak_the_best_relevancy_decides():
    scene = blob_scene()
    for found, says in ((0.6, True), (0.9999, True), (1.0, False)):
        field = replace(language(), reading=Reading(found=found))
        scene = replace(scene, language=field)
        result = QueryEngine(scene, lambda _: FakeEncoder(), rule="peak").run("mug")
        assert (result.found, result.verdict) == (says, "found" if says else "not here")


@pytest.mark.parametrize("rule", RULES)
def test_negative_fits_everywhere(rule):
    gaussians, field = random_gaussians(200), random_field(200, "codebook")
    relevancy = np.random.default_rng(0).uniform(0.05, 0.2, (3, 200)).astype(np.float32)
    for level in ("auto", *LEVELS):
        result = asked(relevancy, build_surface(gaussians), field, rule, level)
        assert (result.found, result.verdict) == (False, "not here")
        assert max(result.fits) < 0
        assert result.heat_range == (FLOOR, pytest.approx(FLOOR + 0.1))
        assert np.isfinite([*result.place, *result.box.ravel()]).all()


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("calibration", [None, SURE])
@pytest.mark.parametrize("count", [0, 1])
def test_almost_no_gaussians(rule, calibration, count):
    field = replace(random_field(count), reading=Reading(calibration=calibration))
    result = QueryEngine(Scene(random_gaussians(count), field), rule=rule).run("red mug")
    assert not result.found
    assert result.members.shape == (count,)
    assert np.isfinite([*result.scores, *result.fits]).all()


@pytest.mark.parametrize("rule", RULES)
def test_no_meaning_anywhere(rule):
    field = random_field(150, "linear")
    field = replace(
        field,
        latents=np.zeros_like(field.latents),
        confidence=np.zeros_like(field.confidence),
        reading=Reading(calibration=SURE),
    )
    result = QueryEngine(Scene(random_gaussians(150), field), rule=rule).run("red mug")
    assert (result.verdict, result.place, result.scores) == ("not here", None, (0, 0, 0))
    assert rule == "peak" or result.probability < 1e-3


def test_evened_relevancy_is_that_of_its_region():
    gaussians, field = random_gaussians(300), random_field(300, "autoencoder")
    gaussians.opacity_logits[:20] = -9  # faint: what is next to them, or if nothing is near, their own
    gaussians.means[:5] += 500
    engine = QueryEngine(Scene(gaussians, field))
    relevancy = engine.relevancy(engine.text_vector("red mug"))
    evened = engine.evened(relevancy)
    assert evened.shape == (3, 300)
    np.testing.assert_array_equal(evened[:, :5], relevancy[:, :5])
    surface, regions = engine.surface, engine.regions
    means = regions.means(relevancy)
    for level in range(3):
        want = means[level].astype(np.float32)[regions.of[level]]
        np.testing.assert_array_equal(evened[level, surface.rows], want)
        near = np.flatnonzero(surface.anchors >= 0)
        np.testing.assert_array_equal(evened[level, near], want[surface.anchors[near]])
        result = engine.run("red mug", LEVELS[level])
        np.testing.assert_allclose(result.even, evened[level], atol=1e-6)
