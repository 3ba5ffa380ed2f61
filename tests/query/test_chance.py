"""What everyday phrases fit in a scene, and what is found because it fits more."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.query import answers as chance_module
from langsplat_core.query.answers import FOUND, Bar, Chance, excess
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.surface import SMALLEST
from langsplat_core.scene import LEVELS, Reading, Scene
from tests.support.fakes import FakeEncoder, blob_scene, language
from tests.support.file_samples import random_field
from tests.support.scenes import random_gaussians

TOLERANCE = {"codebook": 1e-4, "linear": 1e-4, "autoencoder": 5e-3}  # of the table that finds relevancies
BARS = (Bar(0.0, 1.0), Bar(0.5, 1.0), Bar(-1.0, 2.0), Bar(0.6, 0.5))


def engine_of(kind: str) -> QueryEngine:
    return QueryEngine(Scene(random_gaussians(400), random_field(400, kind)))


@pytest.mark.parametrize("kind", ["codebook", "autoencoder", "linear"])
def test_fits_by_chance_are_those_of_looking_everyday_phrases_up(kind, monkeypatch):
    monkeypatch.setattr(chance_module, "CHUNK", 7)  # several
    engine = engine_of(kind)
    everyday = engine.field.everyday
    fits = engine.chance.fits
    for number, vector in enumerate(everyday):
        means = engine.regions.means(engine.relevancy(vector))
        for level in range(len(LEVELS)):
            solid = engine.regions.sizes[level] >= SMALLEST
            want = engine.scale.fit(means[level])
            np.testing.assert_allclose(
                fits[level][solid, number], want[solid], atol=5e-3 if kind == "autoencoder" else 1e-4
            )
            assert np.isneginf(fits[level][~solid, number]).all() or not solid.any()


def test_bars_are_quantiles_of_the_best_and_those_of_some_regions_are_lower():
    rng = np.random.default_rng(0)
    fits = tuple(rng.normal(size=(9, 101)) for _ in LEVELS)
    made = Chance(fits)
    for bar, level in zip(made.bars()[:3], fits, strict=True):
        low, median = np.quantile(level.max(0), [0.16, 0.5])
        assert (bar.median, bar.spread) == (pytest.approx(median), pytest.approx(median - low))
    finer = np.maximum(fits[0].max(0), fits[1].max(0))
    assert made.bars()[3].median == pytest.approx(np.median(finer))
    some = made.bars((np.array([2]), np.array([0, 1]), np.array([], int)))
    assert some[0].median < made.bars()[0].median
    assert not np.isfinite(some[2].median)  # nothing is found where there is nothing


@pytest.mark.parametrize("named", FOUND)
@pytest.mark.parametrize("level", ["auto", *LEVELS])
def test_excess_is_counted_from_the_bars(named, level):
    rng = np.random.default_rng(1)
    whole, finer = FOUND[named]
    for fits in rng.normal(scale=4, size=(50, 3)).tolist():
        if level == "auto":
            by_whole = (fits[2] - BARS[2].median) / BARS[2].spread - whole
            want = max(by_whole, (max(fits[:2]) - BARS[3].median) / BARS[3].spread - finer)
        else:
            bar, fit = BARS[LEVELS.index(level)], fits[LEVELS.index(level)]
            want = (fit - bar.median) / bar.spread - min(whole, finer)
        assert excess(tuple(fits), BARS, named, level) == pytest.approx(want)


def test_a_bar_without_width_is_still_a_number():
    assert np.isfinite(Bar(0.3, 0.0).excess(0.3, 1.0))


def test_the_scene_needs_everyday_phrases_else_the_peak_answers():
    field = replace(language(), everyday=None, reading=Reading(found=0.6))
    scene = replace(blob_scene(), language=field)
    engine = QueryEngine(scene, lambda _: FakeEncoder())  # which knows too few of them
    assert (engine.rule, engine.chance, engine.calibration) == ("peak", None, None)
    result = engine.run("mug")
    assert (result.found, result.excess, result.probability) == (True, None, None)
    few = replace(field, everyday=np.ones((3, 8), np.float32))
    assert QueryEngine(replace(scene, language=few), lambda _: FakeEncoder()).rule == "peak"


def test_an_old_scene_takes_them_from_its_encoder(monkeypatch):
    class Open(FakeEncoder):
        def unknown_words(self, text):
            return ()

        def encode_texts(self, texts):
            known = [text for text in texts if text in ("mug", "book", "plant", "object", "things")]
            if len(known) == len(texts):
                return super().encode_texts(texts)
            noise = np.random.default_rng(len(texts)).normal(scale=0.2, size=(len(texts), 8))
            noise[:, 3] += 1
            named = {name: row for row, name in enumerate(("mug", "book", "plant"))}
            for row, text in enumerate(texts):
                if text in ("object", "things", "stuff", "texture"):
                    noise[row] = np.eye(8)[3]
                elif text in named:
                    noise[row] = np.eye(8)[named[text]]
            return (noise / np.linalg.norm(noise, axis=1)[:, None]).astype(np.float32)

    scene = replace(blob_scene(), language=replace(language(), everyday=None))
    engine = QueryEngine(scene, lambda _: Open())
    assert engine.rule == "regions"
    result = engine.run("mug")
    assert result.found
    assert result.excess >= 0
