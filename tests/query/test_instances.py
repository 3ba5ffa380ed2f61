"""Instances: taken apart where the surface is, against plain graphs and float64 means."""

import numpy as np
import pytest

from langsplat_core.arrays import Array, logit, rotation_matrices, sigmoid
from langsplat_core.query import instances
from langsplat_core.query.instances import OrientedBox, axis_aligned_box, find_instances, oriented_box
from langsplat_core.scene import Gaussians
from langsplat_core.scene.surface import Surface, build_surface
from tests.support.scenes import random_gaussians, unturned_gaussians


def balls(sizes: list[int]) -> tuple[Gaussians, Array]:
    """Balls of Gaussians one unit apart along x; and the number of its ball for each."""
    rng = np.random.default_rng(3)
    number = np.repeat(np.arange(len(sizes)), sizes)
    shape = len(number), 3
    means = rng.uniform(-0.1, 0.1, shape) + number[:, None] * [1.0, 0, 0]
    return unturned_gaussians(means, np.log(rng.uniform(0.01, 0.03, shape)), logit(np.array(0.9))), number


def extents(gaussians: Gaussians) -> Array:
    """(N,) float64, as documented: opacity times the largest cross-section."""
    scales = np.exp(np.sort(gaussians.log_scales.astype(np.float64), axis=1))
    return sigmoid(gaussians.opacity_logits.astype(np.float64)) * scales[:, 1] * scales[:, 2]


def smoothed(surface: Surface, values: Array) -> Array:
    """(M,) float64: the weighted mean over each neighbourhood."""
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
    smooth = smoothed(surface, relevancy)
    for instance, ball in zip(found, (1, 2, 0), strict=True):
        own = np.flatnonzero((number == ball) & members)
        assert instance.members.tolist() == own.tolist()
        on_surface = np.flatnonzero(np.isin(surface.rows, own))
        weights = surface.weights[on_surface].astype(np.float64) / surface.weights[on_surface].sum()
        points = surface.positions[on_surface]
        assert instance.score == pytest.approx(smooth[on_surface].max(), abs=1e-6)
        assert instance.mean == pytest.approx(weights @ relevancy[surface.rows[on_surface]], abs=1e-6)
        np.testing.assert_allclose(instance.centre, weights @ points, atol=1e-6)
        np.testing.assert_allclose(instance.box, np.quantile(points, [0.02, 0.98], axis=0), atol=1e-12)
        assert instance.share == pytest.approx(
            extents(gaussians)[own].sum() / extents(gaussians)[members].sum()
        )
    assert [i.count for i in find_instances(surface, gaussians, members, relevancy, at_most=2)] == [200, 90]


def test_voted_wholes_divide_touching_instances():
    """A row of 80 that touch: two wholes, then ten of none. An answer of wholes joins what is of one of them,
    a finer one takes apart what lies apart."""
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


def test_boxes_of_many_points_use_a_sample(measured):
    gaussians, _ = balls([5 * instances.BOXED])
    surface = build_surface(gaussians)
    (found,) = find_instances(surface, gaussians, np.ones(len(gaussians), bool), np.ones(len(gaussians)))
    assert instances.BOXED / 2 < len(found.points) <= instances.BOXED
    error = np.abs(found.box - np.quantile(surface.positions, [0.02, 0.98], axis=0)).max() / 0.2
    measured("boxes of a fifth of the points", "error of a side, share of it", error)
    assert error < 0.01


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
    found = 2 * box.half_extents
    error = np.abs(found - INSIDE * np.array(sides)).max() / max(sides)
    measured(f"oriented box of {sides}", "error of a side, share of the longest", error)
    assert error < 0.08


def test_boxes_ignore_strays():
    points = filled((3, 2, 1))
    before = oriented_box(points)
    points[:20] = np.random.default_rng(1).normal(scale=50, size=(20, 3))
    np.testing.assert_allclose(oriented_box(points).half_extents, before.half_extents, rtol=0.1)
    assert (np.abs(axis_aligned_box(points)) < 1.6).all()


def test_boxes_hold_points_between_their_quantiles():
    points = filled((1, 2, 3)) @ turned(2).T
    box = oriented_box(points)
    low, high = axis_aligned_box(points)
    for inside in (box.contains(points), ((points >= low) & (points <= high)).all(1)):
        assert 1 - 3 * (1 - INSIDE) - 0.01 <= inside.mean() < 1
    assert box.contains(box.corners).all()


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
