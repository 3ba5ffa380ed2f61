"""How far an answer reaches, against the rule written out region by region."""

import math
from itertools import product

import numpy as np
import pytest

from langsplat_core.arrays import Array, sigmoid
from langsplat_core.query.extent import ADVANTAGE, FAINT, NARROWEST, SHARES, cut, find_extent, to_margin
from langsplat_core.query.regions import SMALLEST, Regions, regions_from
from langsplat_core.query.surface import Surface, build_surface
from langsplat_core.query.vocabulary import Named
from langsplat_core.scene import LEVELS
from tests.support.scenes import random_gaussians

T = 10.0
N = 300


@pytest.fixture(scope="module")
def surface() -> Surface:
    return build_surface(random_gaussians(N), min_opacity=0.0)


def regions_of(surface: Surface, sizes: tuple[int, ...]) -> Regions:
    """Of one partition at all levels; `sizes` add up to the Gaussians of the surface."""
    of = np.repeat(np.arange(len(sizes), dtype=np.int32), sizes)
    return regions_from(surface, np.stack([of] * 3))


def spread_out(surface: Surface, regions: Regions, margins) -> Array:
    """(3, N) relevancy that has the given margins, of each level and region."""
    relevancy = np.zeros((3, len(surface.anchors)), np.float32)
    for level, row in enumerate(margins):
        relevancy[level, surface.rows] = sigmoid(T * np.asarray(row, np.float64))[regions.of[level]]
    return relevancy


def plain_extent(margins, sizes, level: str, named: Named) -> tuple[int, list[bool]]:
    """The level and the regions that answer."""
    solid = [n for n, size in enumerate(sizes) if size >= SMALLEST] or list(range(len(sizes)))
    best = [max(row[n] for n in solid) for row in margins]
    given = [value + more for value, more in zip(best, ADVANTAGE[named], strict=True)]
    chosen = given.index(max(given)) if level == "auto" else LEVELS.index(level)
    top, share = best[chosen], SHARES[chosen]
    limit = share * top if top > FAINT else top - (1 - share) * FAINT
    return chosen, [value > limit for value in margins[chosen]]


@pytest.mark.parametrize(("level", "named"), [*product(["auto"], ADVANTAGE), *product(LEVELS, ["part"])])
@pytest.mark.parametrize("middle", [-0.3, 0.0, 0.15])
def test_the_extent_is_that_of_the_plain_rule(surface, level, named, middle):
    rng = np.random.default_rng(0)
    count = len(surface.rows)
    for _ in range(30):
        sizes = (*rng.integers(3, 30, 9).tolist(),)
        sizes = (*sizes, count - sum(sizes))
        margins = middle + 0.1 * rng.normal(size=(3, len(sizes)))
        regions = regions_of(surface, sizes)
        got = find_extent(spread_out(surface, regions, margins), regions, T, level, named)
        chosen, answering = plain_extent(margins, sizes, level, named)
        assert got.level == chosen
        np.testing.assert_array_equal(got.inside, answering)
        solid = np.array(sizes) >= SMALLEST
        np.testing.assert_allclose(got.margins, margins[:, solid].max(1), atol=1e-5)
        np.testing.assert_allclose(got.peaks, sigmoid(T * margins[:, solid].max(1)), atol=1e-6)
        np.testing.assert_allclose(got.even, sigmoid(T * margins[chosen]), atol=1e-6)
        assert got.even.dtype == np.float32
        assert got.inside.any()


@pytest.mark.parametrize(
    ("best", "named", "level"),
    [
        ((0.2, 0.2, 0.2), "thing", 2),
        ((0.2, 0.2, 0.09), "thing", 2),
        ((0.2, 0.1, 0.07), "thing", 0),
        ((-0.5, -0.3, -0.4), "thing", 2),
        ((0.2, 0.2, 0.18), "part", 2),
        ((0.21, 0.2, 0.15), "part", 0),
        ((0.2, 0.18, 0.2), "part of a thing", 1),
        ((0.2, 0.16, 0.2), "part of a thing", 0),
        ((-0.5, -0.3, -0.2), "part of a thing", 2),
    ],
)
def test_the_level_is_the_best_one_after_what_speaks_for_it(surface, best, named, level):
    regions = regions_of(surface, (100, len(surface.rows) - 100))
    margins = [(value, value - 0.4) for value in best]
    assert find_extent(spread_out(surface, regions, margins), regions, T, named=named).level == level


def test_crumbs_set_no_scale_unless_there_is_nothing_else(surface):
    count = len(surface.rows)
    regions = regions_of(surface, (SMALLEST - 1, 50, count - 50 - SMALLEST + 1))
    margins = [(0.9, 0.2, -0.4)] * 3
    got = find_extent(spread_out(surface, regions, margins), regions, T)
    assert got.margins == pytest.approx((0.2,) * 3, abs=1e-5)
    small = build_surface(random_gaussians(4), min_opacity=0.0)
    crumbs = regions_of(small, (1, len(small.rows) - 1))
    got = find_extent(spread_out(small, crumbs, [(0.9, 0.2)] * 3), crumbs, T)
    assert got.margins == pytest.approx((0.9,) * 3, abs=1e-4)


def test_where_everything_is_as_bad_all_of_it_answers_and_nothing_is_not_a_number(surface):
    regions = regions_of(surface, (100, len(surface.rows) - 100))
    for value in (0.0, 0.5, 1.0):
        relevancy = np.full((3, N), value, np.float32)
        got = find_extent(relevancy, regions, T)
        assert (got.level, got.inside.all()) == (2, True)
        assert np.isfinite([*got.margins, *got.peaks]).all()
        assert (got.even == np.float32(value)).all()


def test_a_surface_of_nothing():
    surface = build_surface(random_gaussians(0))
    nothing = regions_from(surface, np.zeros((3, 0), np.int32))
    got = find_extent(np.zeros((3, 0), np.float32), nothing, T, "part")
    assert (got.level, got.peaks) == (1, (0, 0, 0))
    assert (got.even.shape, got.inside.shape) == ((0,), (0,))
    assert np.isfinite(got.margins).all()


def test_a_margin_is_relevancy_without_its_temperature():
    margins = np.linspace(-0.6, 0.6, 50)
    for temperature in (2.0, 10.0, 11.7):
        np.testing.assert_allclose(to_margin(sigmoid(temperature * margins), temperature), margins, atol=1e-9)
    ends = to_margin(np.array([0.0, 1.0]), T)
    assert ends == pytest.approx(np.array([-1, 1]) * math.log((1 - NARROWEST) / NARROWEST) / T)


def test_the_cut_is_below_the_best_and_rises_with_it():
    best = np.linspace(-0.5, 0.5, 2001)
    for share in SHARES:
        cuts = np.array([cut(value, share) for value in best.tolist()])
        assert (cuts < best).all()
        assert (np.diff(cuts) > 0).all()
        assert np.diff(cuts).max() < 2 * (best[1] - best[0])  # no jump where the scale becomes too faint
