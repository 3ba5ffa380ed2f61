"""How far an answer reaches, against the rule written out region by region."""

from itertools import product

import numpy as np
import pytest

from langsplat_core.arrays import Array, sigmoid
from langsplat_core.query.answers import ADVANTAGE, FARTHEST, NEAREST, REACH, find_extent, lowest
from langsplat_core.query.grammar import Named
from langsplat_core.query.surface import SMALLEST, Regions, Surface, build_surface, regions_from
from langsplat_core.scene import LEVELS
from langsplat_core.semantics.relevancy import Scale
from tests.support.scenes import random_gaussians

SCALE = Scale(np.eye(2, dtype=np.float32), np.eye(2, dtype=np.float32), 10.0)
N = 300


@pytest.fixture(scope="module")
def surface() -> Surface:
    return build_surface(random_gaussians(N), min_opacity=0.0)


def regions_of(surface: Surface, sizes: tuple[int, ...]) -> Regions:
    """Of one partition at all levels; `sizes` add up to the Gaussians of the surface."""
    of = np.repeat(np.arange(len(sizes), dtype=np.int32), sizes)
    return regions_from(surface, np.stack([of] * 3))


def spread_out(surface: Surface, regions: Regions, fits) -> Array:
    """(3, N) relevancy that has the given fits, of each level and region."""
    relevancy = np.zeros((3, len(surface.anchors)), np.float32)
    for level, row in enumerate(fits):
        relevancy[level, surface.rows] = sigmoid(np.asarray(row, np.float64))[regions.of[level]]
    return relevancy


def plain_extent(fits, sizes, level: str, named: Named) -> tuple[int, list[bool]]:
    """The level and the regions that answer."""
    solid = [n for n, size in enumerate(sizes) if size >= SMALLEST] or list(range(len(sizes)))
    best = [max(row[n] for n in solid) for row in fits]
    given = [value + more for value, more in zip(best, ADVANTAGE[named], strict=True)]
    chosen = given.index(max(given)) if level == "auto" else LEVELS.index(level)
    limit = best[chosen] - min(max(REACH * best[chosen], NEAREST), FARTHEST)
    return chosen, [value >= limit for value in fits[chosen]]


@pytest.mark.parametrize(("level", "named"), [*product(["auto"], ADVANTAGE), *product(LEVELS, ["part"])])
@pytest.mark.parametrize("middle", [-2.0, 0.0, 1.0])
def test_the_extent_is_that_of_the_plain_rule(surface, level, named, middle):
    rng = np.random.default_rng(0)
    count = len(surface.rows)
    for _ in range(30):
        sizes = (*rng.integers(3, 30, 9).tolist(),)
        sizes = (*sizes, count - sum(sizes))
        fits = middle + rng.normal(size=(3, len(sizes)))
        regions = regions_of(surface, sizes)
        got = find_extent(spread_out(surface, regions, fits), regions, SCALE, level, named)
        chosen, answering = plain_extent(fits, sizes, level, named)
        assert got.level == chosen
        np.testing.assert_array_equal(got.inside, answering)
        solid = np.array(sizes) >= SMALLEST
        np.testing.assert_allclose(got.fits, fits[:, solid].max(1), atol=1e-5)
        np.testing.assert_allclose(got.peaks, sigmoid(fits[:, solid].max(1)), atol=1e-6)
        np.testing.assert_allclose(got.even, sigmoid(fits[chosen]), atol=1e-6)
        assert got.even.dtype == np.float32
        assert got.inside.any()


@pytest.mark.parametrize(
    ("best", "named", "level"),
    [
        ((2.0, 2.0, 2.0), "thing", 2),
        ((2.0, 2.0, 1.6), "thing", 2),
        ((2.0, 1.0, 1.4), "thing", 0),
        ((-5.0, -3.0, -3.4), "thing", 2),
        ((2.0, 2.0, 1.8), "part", 2),
        ((2.1, 2.0, 1.8), "part", 0),
        ((2.0, 2.1, 2.2), "part of a thing", 1),
        ((2.0, 1.6, 2.2), "part of a thing", 0),
        ((-5.0, -3.0, -2.0), "part of a thing", 2),
    ],
)
def test_the_level_is_the_best_one_after_what_speaks_for_it(surface, best, named, level):
    regions = regions_of(surface, (100, len(surface.rows) - 100))
    fits = [(value, value - 4) for value in best]
    assert find_extent(spread_out(surface, regions, fits), regions, SCALE, named=named).level == level


def test_crumbs_set_no_scale_unless_there_is_nothing_else(surface):
    count = len(surface.rows)
    regions = regions_of(surface, (SMALLEST - 1, 50, count - 50 - SMALLEST + 1))
    fits = [(0.9, 0.2, -0.4)] * 3
    got = find_extent(spread_out(surface, regions, fits), regions, SCALE)
    assert got.fits == pytest.approx((0.2,) * 3, abs=1e-5)
    small = build_surface(random_gaussians(4), min_opacity=0.0)
    crumbs = regions_of(small, (1, len(small.rows) - 1))
    got = find_extent(spread_out(small, crumbs, [(0.9, 0.2)] * 3), crumbs, SCALE)
    assert got.fits == pytest.approx((0.9,) * 3, abs=1e-4)


def test_where_everything_is_as_bad_all_of_it_answers_and_nothing_is_not_a_number(surface):
    regions = regions_of(surface, (100, len(surface.rows) - 100))
    for value in (0.0, 0.5, 1.0):
        relevancy = np.full((3, N), value, np.float32)
        got = find_extent(relevancy, regions, SCALE)
        assert (got.level, got.inside.all()) == (2, True)
        assert np.isfinite([*got.fits, *got.peaks]).all()
        assert (got.even == np.float32(value)).all()


def test_a_surface_of_nothing():
    surface = build_surface(random_gaussians(0))
    nothing = regions_from(surface, np.zeros((3, 0), np.int32))
    got = find_extent(np.zeros((3, 0), np.float32), nothing, SCALE, "part")
    assert (got.level, got.peaks) == (1, (0, 0, 0))
    assert (got.even.shape, got.inside.shape) == ((0,), (0,))
    assert np.isfinite(got.fits).all()


def test_the_reach_is_below_the_best_and_rises_with_it():
    best = np.linspace(-5, 5, 2001)
    for share in (0.5, 1.0):
        ends = np.array([lowest(value, share) for value in best.tolist()])
        assert (ends < best).all()
        assert (np.diff(ends) > 0).all()
        assert np.diff(ends).max() < 2 * (best[1] - best[0])  # no jump
