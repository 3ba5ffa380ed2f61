"""The surface, its regions, instances and selections on it, against plain loops in float64."""

import heapq
from dataclasses import replace
from itertools import pairwise
from math import hypot, inf, nan

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from langsplat_core.arrays import Array, logit, rotation_matrices, sigmoid, unit
from langsplat_core.errors import InputError
from langsplat_core.query import instances, selection
from langsplat_core.query.instances import (
    OrientedBox,
    axis_aligned_box,
    find_instances,
    find_wholes,
    oriented_box,
)
from langsplat_core.scene import NO_NODE, Gaussians, LanguageField, Scene, look_at
from langsplat_core.scene import surface as surfaces
from langsplat_core.scene.surface import Surface, build_surface
from tests.support.fakes import CENTRES, PER_BLOB, blob_scene
from tests.support.file_samples import random_field
from tests.support.scenes import random_gaussians, regions_of, tree_of_wholes, unturned_gaussians


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
        near = counted[np.argsort(distances)[: surfaces.NEIGHBOURS]]
        want = (values[near] * opacity[near]).sum() / opacity[near].sum()
        np.testing.assert_allclose(smoothed[number], want, rtol=1e-5)


def test_links_are_symmetric_and_parts_are_the_connected_components():
    surface = build_surface(random_gaussians(500))
    assert (surface.links != surface.links.T).nnz == 0
    numbers = np.flatnonzero(np.random.default_rng(0).uniform(size=len(surface.rows)) < 0.08)
    parts = surface.parts(numbers)
    count, labels = connected_components(surface.links[numbers][:, numbers], directed=False)
    assert len(parts) == count > 3
    inside = np.isin(np.arange(len(surface.rows)), numbers)
    for part in parts:
        want = numbers[labels == labels[numbers.tolist().index(part[0])]]
        assert part.tolist() == want.tolist() == sorted(surface.connected(inside, int(part[-1])))
    assert not np.concatenate(surface.parts(numbers[:0])).size


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
    numbers = np.where((octant < 2) | (confidence[2] == 0), NO_NODE, octant // 2)
    return gaussians, replace(
        field,
        latents=latents.astype(field.latents.dtype),
        confidence=confidence.astype(np.float32),
        tree=tree_of_wholes(numbers) if things else None,
    )


def line(count: int, gaps: tuple[int, ...] = ()) -> Gaussians:
    """Opaque Gaussians in a row, a step apart; before those numbered in `gaps`, a thousand steps."""
    x = np.arange(count) + 1000.0 * np.isin(np.arange(count), gaps).cumsum()
    return unturned_gaussians(np.stack([x, np.zeros(count), np.zeros(count)], 1), 0.0, 3.0)


def plain_step(field: LanguageField, level: int, a: int, b: int) -> float:
    """Between the features of two Gaussians of the scene."""
    known = field.known[level]
    if not (known[a] and known[b]):
        return surfaces.UNKNOWN if known[a] or known[b] else 0.0
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
    above = None if level == 2 else plain_regions(surface, field, level + 1)
    things = None if level < 2 or field.tree is None else field.tree.leaves
    for a, b in np.transpose(np.nonzero(np.triu(surface.links.toarray()))).tolist():
        if above is not None and above[a] != above[b]:
            continue
        one, other = surface.rows[a], surface.rows[b]
        step = min(max(plain_step(field, level, one, other), 0.0), surfaces.UNKNOWN)
        if things is not None and NO_NODE not in things[[one, other]]:
            step = 0.0 if things[one] == things[other] else step + surfaces.BORDER * typical
        steps.append((round(step * surfaces.STEPS), step, a, b))
    steps.sort(key=lambda link: link[0])
    region = {number: frozenset([number]) for number in range(len(surface.rows))}
    within = dict.fromkeys(region.values(), 0.0)  # largest step inside
    for gathering in (False, True):
        for _, step, a, b in steps:
            mine, other = region[a], region[b]
            if mine == other:
                continue
            if gathering:
                join = min(len(mine), len(other)) < surfaces.SMALLEST
            else:
                limits = (within[one] + surfaces.SCALE * typical / len(one) for one in (mine, other))
                join = step <= min(limits)
            if join:
                both = mine | other
                within[both] = max(step, within[mine], within[other])
                region.update(dict.fromkeys(both, both))
    return [min(region[number]) for number in range(len(surface.rows))]


def assert_same_partition(got, want) -> None:
    """Numbers may differ, borders may not."""
    pairs = len(np.unique(np.stack([got, want]), axis=1).T)
    assert pairs == len(np.unique(got)) == len(np.unique(want))


def on_surface_of(regions: selection.Regions, surface: Surface) -> np.ndarray:
    """Return (3, M) region of every Gaussian of the surface."""
    return regions.everywhere[:, surface.rows]


def assert_sound(regions: selection.Regions, surface: Surface) -> None:
    """Numbered from 0 without a gap, sizes as counted, each within one above, none over a gap or small."""
    _, parts = connected_components(surface.links, directed=False)
    every = on_surface_of(regions, surface)
    for level, (of, sizes) in enumerate(zip(every, regions.sizes, strict=True)):
        np.testing.assert_array_equal(np.bincount(of, minlength=len(sizes)), sizes)
        assert (sizes > 0).all()
        if level < 2:
            assert len(np.unique(every[level : level + 2], axis=1).T) == len(sizes)
        assert len(np.unique(np.stack([of, parts]), axis=1).T) == len(sizes)
        around = parts if level == 2 else parts * len(of) + every[level + 1]
        for number in np.flatnonzero(sizes < surfaces.SMALLEST):
            assert (around == around[of.tolist().index(number)]).sum() == sizes[number]  # nobody to join


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("things", [False, True])
def test_regions_follow_the_criterion_written_out(kind, things):
    gaussians, field = patched(kind, seed=KINDS.index(kind), things=things)
    surface = build_surface(gaussians)
    regions = regions_of(Scene(gaussians, field), surface)
    assert_sound(regions, surface)
    for level, of in enumerate(on_surface_of(regions, surface)):
        assert_same_partition(of, plain_regions(surface, field, level))
        assert 1 < len(regions.sizes[level]) < 30  # neither one lump nor crumbs


HALVES, SIDES = np.repeat([0, 1], 40), np.repeat([5, 3, 6], [20, 40, 20])


@pytest.mark.parametrize(
    ("meaning", "known", "things", "finer", "whole"),
    [
        (3, 1, HALVES, HALVES, HALVES),  # two things that touch stay apart
        (SIDES, 1, HALVES, SIDES + 9 * HALVES, HALVES),  # a thing is one whole, whatever its sides mean
        (3, 1, np.where(HALVES, NO_NODE, 4), 0, 0),  # what is of no thing goes by its meaning
        (SIDES, 1, NO_NODE, SIDES, SIDES),
        (3, HALVES, None, HALVES, HALVES),  # what means something is apart from what means nothing
    ],
)
def test_borders_of_regions_on_a_line(meaning, known, things, finer, whole):
    field, gaussians = random_field(80, "codebook"), line(80)
    surface = build_surface(gaussians)
    rows = meaning, known, things
    latents, confidence, things = (None if row is None else np.broadcast_to(row, 80) for row in rows)
    field = replace(
        field,
        latents=np.tile(latents.astype(np.uint16)[:, None], (3, 1, 1)),
        confidence=np.tile(confidence.astype(np.float32), (3, 1)),
        tree=None if things is None else tree_of_wholes(things),
    )
    regions = on_surface_of(regions_of(Scene(gaussians, field), surface), surface)
    for of, want in zip(regions, (finer, finer, whole), strict=True):
        assert_same_partition(of, np.broadcast_to(want, 80)[surface.rows])


def plain_means(surface: Surface, regions: selection.Regions, values: np.ndarray) -> list[np.ndarray]:
    """Region by region, in float64."""
    weights = surface.weights.astype(np.float64)
    of_surface = values.astype(np.float64)[:, surface.rows]
    return [
        np.array([np.average(row[of == r], weights=weights[of == r]) for r in range(of.max(initial=-1) + 1)])
        for of, row in zip(on_surface_of(regions, surface), of_surface, strict=True)
    ]


@pytest.fixture(scope="module")
def scattered() -> tuple[Surface, selection.Regions]:
    """Random Gaussians, a third of them faint and some far from all others."""
    rng = np.random.default_rng(4)
    gaussians = random_gaussians(3000)
    gaussians.means[:] = rng.normal(size=(3000, 3))
    gaussians.means[:20] *= 100
    gaussians.opacity_logits[:] = rng.choice([-4.0, 1.0], 3000, p=[1 / 3, 2 / 3])
    field = random_field(3000, "codebook")
    surface = build_surface(gaussians)
    return surface, regions_of(Scene(gaussians, field), surface)


def test_means_and_spread_follow_their_formulas(scattered):
    """Faint Gaussians beside a region take its value; those near nothing keep their own."""
    surface, regions = scattered
    values = np.random.default_rng(5).uniform(size=(3, 3000)).astype(np.float32)
    near = surface.anchors >= 0
    wanted = plain_means(surface, regions, values)
    for level, (got, want) in enumerate(zip(regions.means(values), wanted, strict=True)):
        assert len(want) > 1
        np.testing.assert_allclose(got, want, rtol=1e-12)
        of = on_surface_of(regions, surface)[level][surface.anchors[near]]
        spread = regions.spread(level, got.astype(np.float32), values[level])
        np.testing.assert_allclose(spread[near], want[of], rtol=1e-6)
        np.testing.assert_array_equal(spread[~near], values[level, ~near])
    assert 0 < (~near).sum() < 3000 / 3 < (regions.weights == 0).sum()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_gaussians_have_a_surface(kind, count):
    surface = build_surface(random_gaussians(count), min_opacity=0.0)
    assert surface.smooth(np.full(count, 0.25, np.float32)).tolist() == [0.25] * len(surface.rows)
    for selected in (np.zeros(count, bool), np.ones(count, bool)):
        assert selection.grow(surface, selected, 1.0).tolist() == selected.tolist()
    field = replace(random_field(count, kind), tree=tree_of_wholes(np.zeros(count, np.int32)))
    regions = regions_of(Scene(line(count), field))
    assert regions.everywhere.tolist() == [[0] * count] * 3
    means = regions.means(np.full((3, count), 0.25, np.float32))
    assert [mean.tolist() for mean in means] == [[0.25] * min(count, 1)] * 3
    lost = line(count)
    lost.means[:] = np.nan
    regions = regions_of(Scene(lost, field))
    assert [len(row) for row in regions.means(np.ones((3, count)))] == [0, 0, 0]
    spread = regions.spread(0, np.zeros(0, np.float32), np.ones(count, np.float32))
    np.testing.assert_array_equal(spread, 1)


# Selections: along the surface against plain walks, and drawn on an image against plain loops.


def sheet(side: int = 20, spacing: float = 0.1) -> Gaussians:
    """A square of opaque Gaussians in the plane z = 0, and one faint one above each."""
    x, y = np.meshgrid(np.arange(side) * spacing, np.arange(side) * spacing)
    flat = np.stack([x.ravel(), y.ravel(), np.zeros(side * side)], -1)
    means = np.concatenate([flat, flat + [0, 0, 0.3 * spacing]])
    return unturned_gaussians(means, np.log(spacing / 2), np.repeat([3.0, -4.0], len(flat)))


def walked(surface: Surface, seeds: np.ndarray) -> np.ndarray:
    """Return (M,) lengths of the shortest ways along links, by Dijkstra's book, in float64."""
    lengths = np.where(seeds, 0.0, inf)
    waiting = [(0.0, int(i)) for i in np.flatnonzero(seeds)]
    while waiting:
        so_far, here = heapq.heappop(waiting)
        for there in surface.links[here].indices:
            step = so_far + np.linalg.norm(surface.positions[here] - surface.positions[there])
            if step < lengths[there]:
                lengths[there] = step
                heapq.heappush(waiting, (float(step), int(there)))
    return lengths


def random_selection(n: int, seed: int = 0, share: float = 0.1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(size=n) < share


def test_spheres_and_boxes_include_their_faces():
    means = np.array([[0, 0, 0], [1, 0, 0], [1.001, 0, 0], [nan, 0, 0], [0, -1, 1]], np.float32)
    assert selection.in_sphere(means, np.zeros(3), 1.0).tolist() == [True, True, False, False, False]
    inside = selection.in_box(means, np.array([0, -1, 0]), np.array([1, 0, 1]))
    assert inside.tolist() == [True, True, False, False, True]


@pytest.mark.parametrize("distance", [0.0, 0.15, 0.4, 100.0])
def test_growing_follows_shortest_paths(distance):
    surface = build_surface(random_gaussians(300))
    selected = random_selection(300, share=0.03)
    lengths = walked(surface, selected[surface.rows])
    grown = selection.grow(surface, selected, distance)
    assert grown[surface.rows].tolist() == (lengths <= distance).tolist()
    assert (grown >= selected).all()


def test_shrinking_undoes_growing_on_a_sheet():
    gaussians = sheet()
    surface = build_surface(gaussians)
    start = selection.in_box(gaussians.means, np.array([0.7, 0.7, -1]), np.array([1.2, 1.2, 1]))
    grown = selection.grow(surface, start, 0.25)
    assert grown.sum() > start.sum()
    assert grown[:400].tolist() == grown[400:].tolist()
    assert (selection.shrink(surface, grown, 0.25) >= start).all()  # closing
    opened = selection.shrink(surface, start, 0.11)
    assert 0 < opened.sum() < start.sum()
    assert (opened <= start).all()
    assert not selection.shrink(surface, start, 1.0).any()
    everything = np.ones(len(gaussians), bool)
    assert selection.shrink(surface, everything, 5.0).all()  # nothing is lost where the surface ends
    everything[400:] = random_selection(400)  # nor to a faint Gaussian that is not selected
    assert selection.shrink(surface, everything, 0.2).tolist() == everything.tolist()


def test_at_point_selects_the_nearest_region():
    scene = blob_scene()
    surface, blob = build_surface(scene.gaussians), np.repeat(np.arange(3), PER_BLOB)
    regions = regions_of(scene, surface)
    for number, point in ((0, CENTRES[0]), (2, CENTRES[2] + [9.0, 0, 0])):
        assert selection.at_point(surface, regions, 2, point).tolist() == (blob == number).tolist()
    surface = build_surface(scene.take(np.zeros(len(scene.gaussians), bool)).gaussians)
    assert len(selection.at_point(surface, regions, 2, np.zeros(3))) == 0


@pytest.mark.parametrize("wrong", [-1, inf, nan])
def test_invalid_distances_are_refused(wrong):
    with pytest.raises(InputError, match="give 0 or more"):
        selection.grow(build_surface(sheet(5)), np.zeros(50, bool), wrong)


SIZE = (80, 60)


@pytest.fixture
def seen() -> selection.Projected:
    """Places all over the picture and beyond it, a few of them behind the camera."""
    rng = np.random.default_rng(3)
    depths = rng.uniform(0.5, 9.0, 700)
    depths[:30] = -1.0
    return selection.Projected(rng.uniform(-10, 95, (700, 2)), depths)


def plainly_from_segment(x: float, y: float, start, end) -> float:
    (x0, y0), (x1, y1) = start, end
    square = (x1 - x0) ** 2 + (y1 - y0) ** 2
    t = 0.0 if square == 0 else min(max(((x - x0) * (x1 - x0) + (y - y0) * (y1 - y0)) / square, 0.0), 1.0)
    return hypot(x - x0 - t * (x1 - x0), y - y0 - t * (y1 - y0))


def from_line(seen: selection.Projected, line) -> np.ndarray:
    """Return (N,) distances from the line, pixels, by a loop."""
    ends = [*pairwise(line.tolist())]
    return np.array([min(plainly_from_segment(x, y, *pair) for pair in ends) for x, y in seen.pixels])


def within(seen: selection.Projected) -> np.ndarray:
    """Return (N,) bool: ahead and in the image."""
    return (seen.depths > 0) & (seen.pixels >= 0).all(1) & (seen.pixels < SIZE).all(1)


def test_polygon_holds_points_by_the_even_odd_rule(seen):
    box = np.array([[20, 5], [60, 5], [60, 40], [20, 40.0]])
    hole = box * 0.5 + (20, 11.25)  # a second turn inside the first
    for outline, wanted in (
        (box, selection.in_rectangle(seen, box[0], box[2])),
        (box[::-1], selection.in_rectangle(seen, box[2], box[0])),
        (
            np.concatenate([box, box[:1], hole, hole[:1]]),
            selection.in_rectangle(seen, box[1], box[3]) & ~selection.in_rectangle(seen, hole[3], hole[1]),
        ),
    ):
        # on the edge a pixel counts whole
        sure = from_line(seen, np.concatenate([outline, outline[:1]])) > 1.5
        assert wanted[sure].sum() > 20
        np.testing.assert_array_equal(selection.in_polygon(seen, outline, SIZE)[sure], wanted[sure])
    for few in (np.zeros((0, 2)), np.array([[0.0, 0.0], [80.0, 60.0]])):
        assert not selection.in_polygon(seen, few, SIZE).any()


def test_stroke_is_as_wide_as_its_brush(seen):
    path = np.array([[10, 10], [60, 15], [60, 15], [62, 50.0]])
    for line, radius in ((path, 6.5), (np.array([[40, 30.0]] * 2), 12.0)):  # a brush that stood still: a disk
        away = from_line(seen, line)
        wanted, sure = (away <= radius) & within(seen), np.abs(away - radius) > 1.5
        assert 10 < wanted.sum() < 300
        np.testing.assert_array_equal(selection.in_stroke(seen, line, radius, SIZE)[sure], wanted[sure])
    assert not selection.in_stroke(seen, np.zeros((0, 2)), 12.0, SIZE).any()


def test_points_behind_the_camera_are_never_inside():
    camera = look_at(np.array([0, 0, -5.0]), np.zeros(3), np.array([0, -1.0, 0]), SIZE)
    means = np.array([[0, 0, 0], [0, 0, -9], [0, 0, -5], [nan, 0, 0], [inf, 0, 0]], np.float32)
    seen = selection.project(means, camera)
    assert seen.depths.tolist() == [5.0, -1.0, -1.0, -1.0, -1.0]
    np.testing.assert_allclose(seen.pixels[0], (40, 30))
    everywhere = np.array([[-9, -9], [90, -9], [90, 70], [-9, 70.0]])
    only_the_first = [True, False, False, False, False]
    assert selection.in_polygon(seen, everywhere, SIZE).tolist() == only_the_first
    assert selection.in_stroke(seen, everywhere, 99.0, SIZE).tolist() == only_the_first
    assert selection.on_surface(seen, np.zeros((60, 80)), SIZE).tolist() == only_the_first


@pytest.mark.parametrize("coarser", [1, 4])
def test_points_behind_the_surface_are_hidden(seen, coarser):
    depths = np.full((60 // coarser, 80 // coarser), 4.0)
    depths[:, : 40 // coarser] = 0  # nothing is drawn there, and nothing hides
    found = selection.on_surface(seen, depths, SIZE, behind=0.05)
    (x, y), z = seen.pixels.T, seen.depths
    in_picture = (z > 0) & (x >= 0) & (x < 80) & (y >= 0) & (y < 60)
    assert found.tolist() == (in_picture & ((x < 40) | (z <= 4.2))).tolist()
    assert 0 < found.sum() < selection.in_rectangle(seen, np.zeros(2), np.array(SIZE)).sum()


# Instances: taken apart where the surface is, against plain graphs and float64 means.


def balls(sizes: list[int]) -> tuple[Gaussians, Array]:
    """Balls of Gaussians one unit apart along x; and the number of its ball for each."""
    rng = np.random.default_rng(3)
    number = np.repeat(np.arange(len(sizes)), sizes)
    shape = len(number), 3
    means = rng.uniform(-0.1, 0.1, shape) + number[:, None] * [1.0, 0, 0]
    return unturned_gaussians(means, np.log(rng.uniform(0.01, 0.03, shape)), logit(np.array(0.9))), number


def extents(gaussians: Gaussians) -> Array:
    """Return (N,) float64, as documented: opacity times the largest cross-section."""
    scales = np.exp(np.sort(gaussians.log_scales.astype(np.float64), axis=1))
    return sigmoid(gaussians.opacity_logits.astype(np.float64)) * scales[:, 1] * scales[:, 2]


def smoothed(surface: Surface, values: Array) -> Array:
    """Return (M,) float64: the weighted mean over each neighbourhood."""
    weights = surface.weights.astype(np.float64)[surface.neighbours]
    return (weights * values.astype(np.float64)[surface.rows][surface.neighbours]).sum(1) / weights.sum(1)


def test_every_ball_is_an_instance_with_its_figures():
    gaussians, number = balls([60, 200, 90])
    relevancy = np.array([0.7, 0.9, 0.8])[number] + 0.01 * np.sin(np.arange(350))
    surface = build_surface(gaussians)
    members = np.ones(350, bool)
    members[5] = False
    found = find_instances(surface, gaussians, members, relevancy)
    assert [instance.count for instance in found] == [200, 90, 59]
    smooth, shares = smoothed(surface, relevancy), extents(gaussians)
    for instance, ball in zip(found, (1, 2, 0), strict=True):
        own = np.flatnonzero((number == ball) & members)
        assert instance.members.tolist() == own.tolist()
        there = np.flatnonzero(np.isin(surface.rows, own))
        weights = surface.weights[there].astype(np.float64) / surface.weights[there].sum()
        points = surface.positions[there]
        assert instance.score == pytest.approx(smooth[there].max(), abs=1e-6)
        assert instance.mean == pytest.approx(weights @ relevancy[surface.rows[there]], abs=1e-6)
        np.testing.assert_allclose(instance.centre, weights @ points, atol=1e-6)
        np.testing.assert_allclose(instance.box, np.quantile(points, [0.02, 0.98], axis=0), atol=1e-12)
        assert instance.share == pytest.approx(shares[own].sum() / shares[members].sum())
    assert [i.count for i in find_instances(surface, gaussians, members, relevancy, at_most=2)] == [200, 90]


def test_voted_wholes_divide_touching_instances():
    """A row of 80 that touch: two wholes, ten of none. Wholes join what is theirs, finer answers do not."""
    gaussians = balls([80])[0]
    gaussians.means[:] = np.stack([np.arange(80), np.zeros(80), np.zeros(80)], 1)
    surface, wholes = build_surface(gaussians), np.repeat([7, 3, -1], [40, 30, 10])
    members, relevancy = np.ones(80, bool), np.full(80, 0.8)

    def counts(inside: np.ndarray, *told: object) -> list[int]:
        return sorted(i.count for i in find_instances(surface, gaussians, inside, relevancy, None, *told))

    assert counts(members) == [80]
    assert counts(members, wholes, True) == counts(members, wholes, False) == [10, 30, 40]
    members[15:26] = False
    assert counts(members, wholes, True) == [10, 29, 30]
    assert counts(members, wholes, False) == [10, 14, 15, 30]


def test_wholes_are_found_without_a_surface():
    gaussians, number = balls([60, 200, 90, 4])
    gaussians.opacity_logits[::10] = -6.0  # faint
    gaussians.means[7, 0] = np.nan
    even, wholes = np.array([0.7, 0.9, 0.8, 0.8])[number], np.array([4, 2, 9, 5])[number]
    members = number > -1
    members[70:80] = False
    wanted = find_instances(build_surface(gaussians), gaussians, members, even, None, wholes, True)
    found = find_wholes(gaussians, members, even, wholes)
    assert [thing.members.tolist() for thing in found] == [thing.members.tolist() for thing in wanted]
    for field in ("score", "mean", "centre", "share"):
        pairs = [(getattr(a, field), getattr(b, field)) for a, b in zip(found, wanted, strict=True)]
        np.testing.assert_allclose(*zip(*pairs, strict=True), rtol=1e-5)
    assert len(find_wholes(gaussians, members, even, wholes, 2)) == 2
    assert find_wholes(gaussians, ~members & (number == 2), even, wholes) == ()
    wholes[3] = -1
    assert find_wholes(gaussians, members, even, wholes) is None


def test_equal_scores_are_ranked_by_size():
    gaussians, number = balls([50, 150, 80])
    relevancy = 0.8 + np.array([0.4, 0.0, 0.2])[number] * instances.EQUAL_SCORES
    found = find_instances(build_surface(gaussians), gaussians, np.ones(280, bool), relevancy)
    assert [instance.count for instance in found] == [150, 80, 50]


def test_crumbs_are_dropped_unless_there_is_nothing_else():
    gaussians, number = balls([400, 20, 20, 30])
    gaussians.log_scales[number == 3] -= 4  # many, but of hardly any extent
    surface, relevancy = build_surface(gaussians), np.full(len(number), 0.7)
    relevancy[number == 1] = 0.99
    members = np.ones(len(number), bool)
    members[400 + instances.CRUMB_COUNT - 1 : 420] = False
    members[420 + instances.CRUMB_COUNT : 440] = False
    found = find_instances(surface, gaussians, members, relevancy)
    assert [instance.count for instance in found] == [400, instances.CRUMB_COUNT]
    assert sum(instance.share for instance in found) < 1
    (only,) = find_instances(surface, gaussians, members & (number == 1), relevancy)
    assert only.count == instances.CRUMB_COUNT - 1
    assert only.share == pytest.approx(1)


def test_faint_gaussians_join_the_nearest_instance():
    gaussians, number = balls([100, 100])
    gaussians.opacity_logits[:] = 3.0
    gaussians.opacity_logits[::10] = -6.0
    gaussians.means[0] = [0.5, 3.0, 0]  # faint and near nothing
    surface = build_surface(gaussians)
    assert len(surface.rows) == 180
    assert surface.anchors[0] == -1
    members = np.ones(200, bool)
    members[number == 1] = False
    members[110] = True  # faint, in the ball that is not meant
    found = find_instances(surface, gaussians, members, np.full(200, 0.8))
    assert [instance.members.tolist() for instance in found] == [list(range(1, 100))]


def test_empty_flat_and_transparent_gaussians_have_finite_shares():
    gaussians = random_gaussians(50)
    surface = build_surface(gaussians)
    faint = ~np.isin(np.arange(50), surface.rows)
    assert faint.any()
    for members in (np.zeros(50, bool), faint):
        assert find_instances(surface, gaussians, members, np.ones(50)) == ()
    none = random_gaussians(0)
    assert find_instances(build_surface(none), none, np.zeros(0, bool), np.zeros(0)) == ()
    gaussians, _ = balls([40, 40])
    gaussians.log_scales[:, 2] = -np.inf
    gaussians.opacity_logits[:] = -np.inf
    found = find_instances(build_surface(gaussians), gaussians, np.ones(80, bool), np.full(80, 0.8))
    assert [instance.share for instance in found] == [0.0, 0.0]
    assert all(np.isfinite(instance.centre).all() for instance in found)


# Boxes around points whose box is known.

INSIDE = instances.INNER[1] - instances.INNER[0]  # of a side, where points are spread evenly over it


def turned(seed: int) -> Array:
    return rotation_matrices(np.random.default_rng(seed).normal(size=(1, 4)))[0]


def filled(sides: tuple[float, float, float], count: int = 2000, seed: int = 0) -> Array:
    return np.random.default_rng(seed).uniform(-0.5, 0.5, size=(count, 3)) * sides


def check(box: OrientedBox) -> None:
    np.testing.assert_allclose(box.axes.T @ box.axes, np.eye(3), atol=1e-12)
    assert np.linalg.det(box.axes) == pytest.approx(1)
    assert (np.diff([*box.half_extents, 0]) <= 0).all()
    assert np.isfinite(box.centre).all()


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("sides", [(3, 2, 1), (1, 1, 0.3), (2, 0.5, 0.5), (1, 1, 1), (4, 3, 0)])
def test_oriented_box_recovers_a_turned_box(sides, seed, measured):
    rotation, shift = turned(seed), np.array([5.0, -2, 9])
    box = oriented_box(filled(sides, seed=seed) @ rotation.T + shift)
    check(box)
    np.testing.assert_allclose(box.centre, shift, atol=0.03 * max(sides))
    error = np.abs(2 * box.half_extents - INSIDE * np.array(sides)).max() / max(sides)
    measured(f"oriented box of {sides}", "error of a side, share of the longest", error)
    assert error < 0.08


def test_boxes_ignore_strays():
    points = filled((3, 2, 1))
    before = oriented_box(points)
    points[:20] = np.random.default_rng(1).normal(scale=50, size=(20, 3))
    np.testing.assert_allclose(oriented_box(points).half_extents, before.half_extents, rtol=0.1)
    assert (np.abs(axis_aligned_box(points)) < 1.6).all()


@pytest.mark.parametrize(
    "points",
    [
        *(np.zeros((1, 3)), np.full((7, 3), 4.0), np.array([[0.0, 0, 0], [1, 2, 3]])),
        *(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), filled((2, 1, 0))),
        *(filled((1, 1, 1)) * 1e-20, filled((1, 1, 1)) * 1e20, filled((1, 1, 1)).astype(np.float32)),
    ],
    ids=["one", "coincident", "two", "three", "plane", "tiny", "huge", "float32"],
)
def test_degenerate_points_have_boxes(points):
    check(oriented_box(points))
    assert np.isfinite(axis_aligned_box(points)).all()


def test_line_has_a_length():
    box = oriented_box(np.linspace(0, 1, 101)[:, None] * [3.0, 4, 0])
    check(box)
    np.testing.assert_allclose(2 * box.half_extents, [5 * INSIDE, 0, 0], atol=1e-9)
    np.testing.assert_allclose(np.abs(box.axes[:, 0]), [0.6, 0.8, 0], atol=1e-9)
