"""Regions of the surface, against the criterion written out plainly in float64."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from langsplat_core.arrays import Array, unit
from langsplat_core.query.surface import (
    BORDER,
    SCALE,
    SMALLEST,
    STEPS,
    UNKNOWN,
    Regions,
    Surface,
    build_regions,
    build_surface,
)
from langsplat_core.scene import NO_THING, Gaussians, LanguageField
from tests.support.file_samples import random_field
from tests.support.scenes import random_gaussians

KINDS = ("codebook", "autoencoder", "linear")
N = 300


def patched(kind: str, seed: int = 0, things: bool = False) -> tuple[Gaussians, LanguageField]:
    """A cloud whose octants mean something each, with noise, strays, and Gaussians that mean nothing."""
    rng = np.random.default_rng(seed)
    gaussians = random_gaussians(N, seed)
    octant = ((gaussians.means > np.median(gaussians.means, axis=0)) @ [1, 2, 4]).astype(int)
    field = random_field(N, kind, seed=seed)
    said = np.where(rng.uniform(size=(3, N)) < 0.2, rng.integers(8, size=(3, N)), octant)
    if kind == "codebook":
        latents = said[..., None].astype(np.uint16)
    else:
        d = field.codec.latent_dim
        latents = unit(unit(rng.normal(size=(8, d)))[said] + 0.2 * rng.normal(size=(3, N, d)))
    confidence = field.confidence * (rng.uniform(size=(3, N)) < 0.9)
    # The first thing was never outlined, nor what has no meaning as a whole.
    numbers = np.where((octant < 2) | (confidence[2] == 0), NO_THING, octant // 2).astype(np.uint16)
    return gaussians, replace(
        field,
        latents=latents.astype(field.latents.dtype),
        confidence=confidence.astype(np.float32),
        things=numbers if things else None,
    )


def line(count: int, gaps: tuple[int, ...] = ()) -> Gaussians:
    """Opaque Gaussians in a row, a step apart; before those numbered in `gaps`, a thousand steps."""
    x = np.arange(count) + 1000.0 * np.isin(np.arange(count), gaps).cumsum()
    return Gaussians(
        means=np.stack([x, np.zeros(count), np.zeros(count)], 1),
        log_scales=np.zeros((count, 3)),
        quats_wxyz=np.tile([1.0, 0, 0, 0], (count, 1)),
        opacity_logits=np.full(count, 3.0),
        sh=np.zeros((count, 1, 3)),
    )


def one_meaning(count: int, things: Array | None = None) -> LanguageField:
    field = random_field(count, "codebook")
    return replace(
        field,
        latents=np.full_like(field.latents, 3),
        confidence=np.ones_like(field.confidence),
        things=None if things is None else np.asarray(things, np.uint16),
    )


def links_of(surface: Surface) -> list[tuple[int, int]]:
    links = surface.links.tocoo()
    return [(int(a), int(b)) for a, b in zip(links.row, links.col, strict=True) if a < b]


def plain_step(field: LanguageField, level: int, a: int, b: int) -> float:
    """Between the meanings of two Gaussians of the scene."""
    known = field.known[level]
    if not (known[a] and known[b]):
        return UNKNOWN if known[a] or known[b] else 0.0
    one, other = field.codec.directions(field.latents[level][[a, b]]).astype(np.float64)
    return float(1 - one @ other / (np.linalg.norm(one) * np.linalg.norm(other)))


def plain_typical_step(surface: Surface, field: LanguageField, level: int) -> float:
    """Mean over all pairs of Gaussians with a meaning, each with itself included."""
    rows = [row for row in surface.rows if field.known[level][row]]
    vectors = field.codec.directions(field.latents[level][rows]).astype(np.float64)
    return float(np.mean(1 - vectors @ vectors.T))


def plain_regions(surface: Surface, field: LanguageField, level: int) -> list[int]:
    """Felzenszwalb and Huttenlocher, with sets: the first member of each Gaussian's region."""
    steps, typical = [], plain_typical_step(surface, field, level)
    for a, b in links_of(surface):
        one, other = surface.rows[a], surface.rows[b]
        step = min(max(plain_step(field, level, one, other), 0.0), UNKNOWN)
        if level == 2 and field.things is not None and NO_THING not in field.things[[one, other]]:
            step = 0.0 if field.things[one] == field.things[other] else step + BORDER * typical
        steps.append((round(step * STEPS), step, a, b))
    steps.sort(key=lambda link: link[0])
    region = {number: frozenset([number]) for number in range(len(surface.rows))}
    within = dict.fromkeys(region.values(), 0.0)  # largest step inside
    for gathering in (False, True):
        for _, step, a, b in steps:
            mine, other = region[a], region[b]
            if mine == other:
                continue
            if gathering:
                join = min(len(mine), len(other)) < SMALLEST
            else:
                join = step <= min(
                    within[mine] + SCALE * typical / len(mine), within[other] + SCALE * typical / len(other)
                )
            if join:
                both = mine | other
                within[both] = max(step, within[mine], within[other])
                region.update(dict.fromkeys(both, both))
    return [min(region[number]) for number in range(len(surface.rows))]


def assert_same_partition(got, want) -> None:
    """Numbers may differ, borders may not."""
    pairs = len(np.unique(np.stack([got, want]), axis=1).T)
    assert pairs == len(np.unique(got)) == len(np.unique(want))


def assert_sound(regions: Regions, surface: Surface) -> None:
    """Numbered from 0 without a gap, sizes as counted, none over a gap of the surface, none too small."""
    _, parts = connected_components(surface.links, directed=False)
    assert (regions.of.shape, regions.of.dtype) == ((3, len(surface.rows)), np.int32)
    for of, sizes in zip(regions.of, regions.sizes, strict=True):
        np.testing.assert_array_equal(np.bincount(of, minlength=len(sizes)), sizes)
        assert (sizes > 0).all()
        assert len(np.unique(np.stack([of, parts]), axis=1).T) == len(sizes)
        for number in np.flatnonzero(sizes < SMALLEST):
            assert (parts == parts[of.tolist().index(number)]).sum() == sizes[number]  # nobody to join


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("things", [False, True])
def test_regions_are_those_of_the_plain_criterion(kind, things):
    gaussians, field = patched(kind, seed=KINDS.index(kind), things=things)
    surface = build_surface(gaussians)
    regions = build_regions(surface, field)
    assert_sound(regions, surface)
    for level in range(3):
        assert_same_partition(regions.of[level], plain_regions(surface, field, level))
        assert 1 < len(regions.sizes[level]) < 30  # neither one lump nor crumbs


@pytest.mark.parametrize("kind", KINDS)
def test_twice_is_the_same(kind):
    gaussians, field = patched(kind, things=True)
    first, second = (build_regions(build_surface(gaussians), field).of for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("kind", KINDS)
def test_the_order_of_the_gaussians_moves_no_border(kind):
    """Where all have a meaning: what has none is as far from everyone, and somebody has to be first."""
    gaussians, field = patched(kind)
    field = replace(field, confidence=np.ones_like(field.confidence))
    order = np.random.default_rng(0).permutation(N)
    found = []
    for scene, meaning, rows in (
        (gaussians, field, np.arange(N)),
        (gaussians.take(order), field.take(order), order),
    ):
        surface = build_surface(scene)
        numbers = np.full((3, N), -1)
        numbers[:, rows[surface.rows]] = build_regions(surface, meaning).of
        found.append(numbers)
    for got, want in zip(*found, strict=True):
        assert_same_partition(got, want)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [0, 1, 2])
def test_almost_no_gaussians(kind, count):
    field = replace(random_field(count, kind), things=np.zeros(count, np.uint16))
    surface = build_surface(line(count))
    regions = build_regions(surface, field)
    assert regions.of.tolist() == [[0] * count] * 3
    means = regions.means(np.full((3, count), 0.25, np.float32))
    assert [mean.tolist() for mean in means] == [[0.25] * min(count, 1)] * 3


@pytest.mark.parametrize("kind", KINDS)
def test_where_nothing_has_a_meaning_a_region_is_what_hangs_together(kind):
    field = random_field(60, kind)
    field = replace(field, confidence=np.zeros_like(field.confidence))
    surface = build_surface(line(60, gaps=(25,)))
    regions = build_regions(surface, field)
    assert_sound(regions, surface)
    assert [sorted(sizes) for sizes in regions.sizes] == [[25, 35]] * 3


def test_one_meaning_is_one_region_for_every_part_of_the_surface():
    surface = build_surface(line(70, gaps=(20, 61)))
    regions = build_regions(surface, one_meaning(70))
    assert_sound(regions, surface)
    assert [sorted(sizes) for sizes in regions.sizes] == [[9, 20, 41]] * 3


def test_two_things_that_touch_stay_apart_as_wholes_alone():
    things = np.repeat([7, 2], 40)
    surface = build_surface(line(80))
    regions = build_regions(surface, one_meaning(80, things))
    assert [len(sizes) for sizes in regions.sizes] == [1, 1, 2]
    assert_same_partition(regions.of[2], things[surface.rows])


def test_a_thing_is_one_region_whatever_its_sides_mean():
    field = one_meaning(80, np.repeat([0, 1], 40))
    latents = field.latents.copy()
    latents[:, :20], latents[:, 60:] = 5, 6
    surface = build_surface(line(80))
    regions = build_regions(surface, replace(field, latents=latents))
    assert [len(sizes) for sizes in regions.sizes] == [3, 3, 2]
    assert_same_partition(regions.of[2], field.things[surface.rows])


def test_what_is_of_no_thing_goes_by_its_meaning():
    nothing = np.full(80, NO_THING)
    nothing[:40] = 4
    surface = build_surface(line(80))
    assert len(build_regions(surface, one_meaning(80, nothing)).sizes[2]) == 1
    plain = build_regions(surface, one_meaning(80)).of
    all_nothing = build_regions(surface, one_meaning(80, np.full(80, NO_THING))).of
    np.testing.assert_array_equal(all_nothing, plain)


def test_meant_and_not_meant_are_apart():
    field = one_meaning(80)
    field.confidence[:, 40:] = 0
    surface = build_surface(line(80))
    regions = build_regions(surface, field)
    for of in regions.of:
        assert_same_partition(of, surface.rows < 40)


def test_means_are_weighted_by_opacity():
    gaussians, field = patched("codebook")
    surface = build_surface(gaussians)
    regions = build_regions(surface, field)
    values = np.random.default_rng(1).uniform(size=(3, N)).astype(np.float32)
    for level, means in enumerate(regions.means(values)):
        assert means.dtype == np.float64
        for number, mean in enumerate(means):
            members = np.flatnonzero(regions.of[level] == number)
            weights = [float(surface.weights[member]) for member in members]
            shares = [float(values[level, surface.rows[member]]) for member in members]
            want = sum(w * v for w, v in zip(weights, shares, strict=True)) / sum(weights)
            assert mean == pytest.approx(want, rel=1e-6)


def test_values_without_meaning_elsewhere_harm_no_mean():
    """Faint Gaussians are off the surface: what they hold is not looked at."""
    gaussians, field = patched("codebook")
    gaussians.opacity_logits[::3] = -9
    surface = build_surface(gaussians)
    values = np.full((3, N), 0.5, np.float32)
    values[:, ::3] = np.nan
    for means in build_regions(surface, field).means(values):
        assert means == pytest.approx(0.5)
