"""The surface: smoothing and walking along it, against plain NumPy."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from langsplat_core.arrays import sigmoid, unit
from langsplat_core.query.surface import (
    BORDER,
    NEIGHBOURS,
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


def test_smoothing_is_the_weighted_mean_of_the_nearest():
    gaussians = random_gaussians(300)
    surface = build_surface(gaussians)
    values = np.random.default_rng(0).uniform(size=300).astype(np.float32)
    smoothed = surface.smooth(values)
    some = np.arange(0, len(smoothed), 7)
    np.testing.assert_allclose(surface.smooth(values, some), smoothed[some], rtol=1e-6)
    opacity = sigmoid(gaussians.opacity_logits.astype(np.float64))
    counted = np.flatnonzero((opacity >= 0.1) & gaussians.valid())
    assert sorted(surface.rows) == counted.tolist()
    for number, row in enumerate(surface.rows):
        distances = np.linalg.norm(gaussians.means[counted] - gaussians.means[row], axis=1)
        near = counted[np.argsort(distances)[:NEIGHBOURS]]
        want = (values[near] * opacity[near]).sum() / opacity[near].sum()
        np.testing.assert_allclose(smoothed[number], want, rtol=1e-5)


def test_links_are_symmetric_and_parts_are_the_connected_components():
    surface = build_surface(random_gaussians(500))
    assert (surface.links != surface.links.T).nnz == 0
    numbers = np.flatnonzero(np.random.default_rng(0).uniform(size=len(surface.rows)) < 0.08)
    parts = surface.parts(numbers)
    count, labels = connected_components(surface.links[numbers][:, numbers], directed=False)
    assert len(parts.starts) == count > 3
    inside = np.isin(np.arange(len(surface.rows)), numbers)
    for part in parts.each():
        want = numbers[labels == labels[numbers.tolist().index(part[0])]]
        assert part.tolist() == want.tolist() == sorted(surface.connected(inside, int(part[-1])))
        assert len(set(parts.labels[part])) == 1
    assert (parts.labels[~inside] < 0).all()
    assert surface.parts(numbers[:0]).each() == []


def test_the_far_side_of_a_gap_is_another_surface():
    gaussians = random_gaussians(60)
    gaussians.means[:] = np.random.default_rng(2).normal(scale=0.05, size=(60, 3))
    gaussians.means[50:, 0] += 9  # fewer than the neighbours everyone has: they reach across
    surface = build_surface(gaussians, min_opacity=0.0)
    near = np.flatnonzero(np.isin(surface.rows, np.arange(50)))
    reached = surface.connected(np.ones(len(surface.rows), bool), int(near[0]))
    assert set(reached) <= set(near)


# Regions of the surface, against the criterion written out plainly in float64.

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
    latents = field.latents[level][rows]
    vectors = field.codec.directions(latents)
    vectors = vectors.astype(np.float64)
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
@pytest.mark.parametrize("known", [0, 1])
def test_one_meaning_or_none_is_a_region_for_every_part_of_the_surface(kind, known):
    field = random_field(70, kind)
    latents = np.broadcast_to(field.latents[:1, :1], field.latents.shape).copy()
    field = replace(field, latents=latents, confidence=np.full_like(field.confidence, known))
    surface = build_surface(line(70, gaps=(20, 61)))
    regions = build_regions(surface, field)
    assert_sound(regions, surface)
    assert [sorted(sizes) for sizes in regions.sizes] == [[9, 20, 41]] * 3


HALVES, SIDES = np.repeat([0, 1], 40), np.repeat([5, 3, 6], [20, 40, 20])


@pytest.mark.parametrize(
    ("meaning", "known", "things", "finer", "whole"),
    [
        (3, 1, HALVES, 0, HALVES),  # two things that touch stay apart, as wholes alone
        (SIDES, 1, HALVES, SIDES, HALVES),  # a thing is one region, whatever its sides mean
        (3, 1, np.where(HALVES, NO_THING, 4), 0, 0),  # what is of no thing goes by its meaning
        (SIDES, 1, NO_THING, SIDES, SIDES),
        (3, HALVES, None, HALVES, HALVES),  # what means something is apart from what means nothing
    ],
)
def test_borders_of_regions_on_a_line(meaning, known, things, finer, whole):
    field, surface = random_field(80, "codebook"), build_surface(line(80))
    latents, confidence, things = (
        None if row is None else np.broadcast_to(row, 80) for row in (meaning, known, things)
    )
    field = replace(
        field,
        latents=np.tile(latents.astype(np.uint16)[:, None], (3, 1, 1)),
        confidence=np.tile(confidence.astype(np.float32), (3, 1)),
        things=None if things is None else things.astype(np.uint16),
    )
    for of, want in zip(build_regions(surface, field).of, (finer, finer, whole), strict=True):
        assert_same_partition(of, np.broadcast_to(want, 80)[surface.rows])


def test_values_without_meaning_elsewhere_harm_no_mean():
    """Faint Gaussians are off the surface: what they hold is not looked at."""
    gaussians, field = patched("codebook")
    gaussians.opacity_logits[::3] = -9
    surface = build_surface(gaussians)
    values = np.full((3, N), 0.5, np.float32)
    values[:, ::3] = np.nan
    for means in build_regions(surface, field).means(values):
        assert means == pytest.approx(0.5)


def plain_means(surface: Surface, regions: Regions, values: np.ndarray) -> list[np.ndarray]:
    """Region by region, in float64."""
    weights = surface.weights.astype(np.float64)
    of_surface = values.astype(np.float64)[:, surface.rows]
    return [
        np.array([np.average(row[of == r], weights=weights[of == r]) for r in range(of.max(initial=-1) + 1)])
        for of, row in zip(regions.of, of_surface, strict=True)
    ]


@pytest.fixture(scope="module")
def scattered() -> tuple[Surface, Regions]:
    """Random Gaussians, a third of them faint and some far from all others."""
    rng = np.random.default_rng(4)
    gaussians = random_gaussians(3000)
    gaussians.means[:] = rng.normal(size=(3000, 3))
    gaussians.means[:20] *= 100
    gaussians.opacity_logits[:] = rng.choice([-4.0, 1.0], 3000, p=[1 / 3, 2 / 3])
    field = random_field(3000, "codebook")
    surface = build_surface(gaussians)
    return surface, build_regions(surface, field)


def test_means_of_regions_and_what_is_spread_from_them(scattered):
    """Faint Gaussians beside a region take its value; those near nothing keep their own."""
    surface, regions = scattered
    values = np.random.default_rng(5).uniform(size=(3, 3000)).astype(np.float32)
    even, near = regions.even(values), surface.anchors >= 0
    wanted = plain_means(surface, regions, values)
    for level, (got, want) in enumerate(zip(regions.means(values), wanted, strict=True)):
        assert len(want) > 1
        np.testing.assert_allclose(got, want, rtol=1e-12)
        of = regions.of[level][surface.anchors[near]]
        np.testing.assert_allclose(even[level, near], want[of], rtol=1e-6)
    np.testing.assert_array_equal(even[:, ~near], values[:, ~near])
    assert 0 < (~near).sum() < 3000 / 3 < (regions.weights == 0).sum()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [0, 1, 2])
def test_almost_no_gaussians(kind, count):
    surface = build_surface(random_gaussians(count), min_opacity=0.0)
    assert surface.smooth(np.full(count, 0.25, np.float32)).tolist() == [0.25] * len(surface.rows)
    field = replace(random_field(count, kind), things=np.zeros(count, np.uint16))
    regions = build_regions(build_surface(line(count)), field)
    assert regions.of.tolist() == [[0] * count] * 3
    means = regions.means(np.full((3, count), 0.25, np.float32))
    assert [mean.tolist() for mean in means] == [[0.25] * min(count, 1)] * 3
    lost = line(count)
    lost.means[:] = np.nan
    regions = build_regions(build_surface(lost), field)
    assert [len(row) for row in regions.means(np.ones((3, count)))] == [0, 0, 0]
    spread = regions.spread(0, np.zeros(0, np.float32), np.ones(count, np.float32))
    np.testing.assert_array_equal(spread, 1)
